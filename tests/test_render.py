"""`autocost render` and `autocost envs`: their pages in a browser, their pictures."""

import base64
import dataclasses
import html
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import jax
import numpy as np
import pytest

from autocost_jax.agents.base import actor
from autocost_jax.cli import main
from autocost_jax.config import ENVS, SUITE, EnvConfig, env_config, preset
from autocost_jax.envs.env import make_env
from autocost_jax.files import flatten
from autocost_jax.population import make_agents
from autocost_jax.runs.directory import RunDir
from autocost_jax.runs.policies import SCRIPTS, scripted_agent
from autocost_jax.runs.sweep import Method, SweepConfig
from autocost_jax.viz import gallery, picture, scene
from autocost_jax.viz.picture import FILMS, FPS, MOST_FRAMES, Job, film_frames
from autocost_jax.viz.player import replay_page
from pages import browse, check_page
from refusals import refused
from test_scene import still_recording

STEPS = 60
SOLID = ["Push-Pillar-Car", "DoggoPush2", "PointGoal2"]  # worlds of all kinds of solids
RENDER = ["render", "--steps", str(STEPS)]

SCRIPT = (Path(__file__).parent / "data" / "use_replay.js").read_text()


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """The page of a scripted policy, and what the command printed."""
    out = tmp_path_factory.mktemp("replay") / "page.html"
    flags = ["--env", "Goal-Hazard-Point", "--policy", "seek", "--out", str(out)]
    main([*RENDER, *flags])
    return out


def use(text, tmp_path):
    """What a page said while `use_replay.js` used it, by occasion."""
    page = tmp_path / "used.html"
    # The browser's clock runs ahead of its frames, so drawing must not wait for one.
    now = "window.requestAnimationFrame = (draw) => setTimeout(draw, 0);"
    text = text.replace("<head>", f"<head><script>{now}</script>")
    page.write_text(text.replace("</body>", f"<script>{SCRIPT}</script></body>"))
    # The address keeps the replay from starting by itself.
    dom, log = browse(tmp_path, page, "--virtual-time-budget=20000", address="#step=0")
    assert "CONSOLE" not in log
    assert "ERR_" not in log
    found = re.search(r'data-notes="([^"]*)"', dom)
    assert found is not None
    return {note["what"]: note for note in json.loads(html.unescape(found.group(1)))}


def sum_of(text, name):
    """The sum of one of the page's arrays."""
    (data,) = json.loads(check_page(text).blocks[0])
    return np.frombuffer(base64.b64decode(data[name]), "<f4").sum()


def test_the_page_is_self_contained(replayed):
    text = replayed.read_text()
    page = check_page(text)
    assert page.title.startswith("Goal-Hazard-Point, seek")
    assert len(text) < 200_000
    for name in ("world-0", "timeline-0", "scrub", "view", "speed", "now-return-0"):
        assert name in page.ids
    assert "now-intrinsic-0" not in page.ids


def test_the_page_can_be_used(replayed, tmp_path):
    text = replayed.read_text()
    notes = use(text, tmp_path)
    assert notes["start"]["step"] == f"step 0 of {STEPS}"
    assert notes["start"]["view"] == "follow"
    assert notes["slider"]["frame"] == 30
    assert notes["slider"]["time"] == "0.6 s"
    for view in ("top", "3d", "follow"):
        assert notes[view]["view"] == view
    assert notes["key"]["frame"] == 31
    assert notes["played"]["frame"] > 31
    assert notes["end"]["step"] == f"step {STEPS} of {STEPS}"
    assert notes["end"]["return"] == pytest.approx(sum_of(text, "reward"), abs=0.006)
    for note in notes.values():
        assert note["colours"] > 20  # shaded solids on a tiled floor, not a blank
    assert notes["bare"]["colours"] != notes["follow"]["colours"]


@pytest.mark.slow
def test_the_address_chooses_moment_and_view(replayed, tmp_path):
    dom, log = browse(tmp_path, replayed, address="#step=25&view=top")
    assert re.search(r'id="now-step">step 25 of 60<', dom)
    assert re.search(r'id="world-0"[^>]*data-view="top"', dom)
    assert "CONSOLE" not in log


@pytest.mark.slow
def test_a_page_by_itself_plays(replayed, tmp_path):
    for seconds in (4, 16, 64):  # on a busy machine the page is slow to begin
        budget = f"--virtual-time-budget={1000 * seconds}"
        dom, _ = browse(tmp_path, replayed, budget, address="")
        frame = re.search(r'id="world-0"[^>]*data-frame="(\d+)"', dom)
        assert frame is not None
        if int(frame.group(1)) > 5:
            return
    pytest.fail(f"it stands at frame {frame.group(1)}")


def still_page(name):
    """The page of a world that stands still, so that nothing is compiled."""
    config = env_config(name)
    replay = scene.make_replay(config, still_recording(config, STEPS))
    return replay, replay_page(name, {}, replay)


@pytest.mark.parametrize("name", SOLID)
def test_every_kind_of_solid_is_in_the_page(name):
    replay, text = still_page(name)
    check_page(text)
    assert sum_of(text, "cost") == pytest.approx(replay.cost.sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLID)
def test_every_kind_of_solid_can_be_drawn(name, tmp_path):
    replay, text = still_page(name)
    notes = use(text, tmp_path)
    assert min(note["colours"] for note in notes.values()) > 20
    assert notes["end"]["cost"] == pytest.approx(replay.cost.sum())


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    """A run directory with one untrained policy, as `autocost train` leaves it."""
    path = tmp_path_factory.mktemp("run") / "train"
    train = preset("smoke").train
    config = SweepConfig(train=train, methods=(Method("ppo", "ppo"),), seeds=(0,))
    (agent,) = make_agents(("ppo_lagrangian",), train, make_env(train.env))
    with RunDir.create(path, config) as run:
        run.write_policy("ppo_seed0", flatten(actor(agent.init(jax.random.key(0)))))
    return path


def test_render_shows_a_saved_policy(run_dir, capsys):
    main([*RENDER, "--run", str(run_dir), "--deterministic", "--seed", "2"])
    out = capsys.readouterr().out
    page = run_dir / "replays" / "ppo_seed0.html"
    assert str(page) in out
    text = page.read_text()
    assert f"in {STEPS} steps" in text
    assert "mean actions, seed 2" in text


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["render"], ["--run", "--env"]),
        (["render", "--run", "nowhere"], ["nowhere"]),
        (["render", "--run", "x", "--env", "Goal-Hazard-Car"], ["--run", "--env"]),
        (
            ["render", "--env", "Goal-Hazard-Cat"],
            ["Goal-Hazard-Cat", "Push-Pillar-Car"],
        ),
        (["render", "--env", "Goal-Hazard-Car", "--policy", "fly"], ["fly", "seek"]),
        (["render", "--env", "Goal-Hazard-Doggo", "--policy", "seek"], ["random"]),
        (["render", "--env", "Goal-Hazard-Car", "--steps", "0"], ["steps", "0"]),
        (["render", "--env", "Goal-Hazard-Car", "--video", "a.avi"], [".mp4", "a.avi"]),
        (
            ["render", "--env", "PointGoal1", "--video", "a.gif", "--size", "3", "64"],
            ["size", "(3, 64)"],
        ),
        (["envs", "Goal-Hazard-Cat"], ["Goal-Hazard-Cat", "Push-Pillar-Car"]),
    ],
)
def test_bad_input_gets_one_line_and_status_2(
    argv, words, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    error = refused(main, argv, capsys)
    for word in words:
        assert word in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["render", "report"])
def test_a_page_is_not_written_over_a_configuration(run_dir, capsys, command):
    before = (run_dir / "config.yaml").read_bytes()
    argv = [command, "--run", str(run_dir), "--out", str(run_dir / "config.yaml")]
    assert "must be an .html file" in refused(main, argv, capsys)
    assert (run_dir / "config.yaml").read_bytes() == before


def test_an_unknown_policy_lists_those_of_the_run(run_dir, capsys):
    argv = ["render", "--run", str(run_dir), "--policy", "best"]
    assert "ppo_seed0" in refused(main, argv, capsys)


@pytest.fixture
def no_gl(monkeypatch):
    """A machine without OpenGL."""
    monkeypatch.setenv("MUJOCO_GL", "off")
    picture.find_backend.cache_clear()
    yield
    picture.find_backend.cache_clear()


def test_without_opengl_there_is_a_page_and_a_hint(no_gl, tmp_path, capsys):
    page, film = tmp_path / "page.html", tmp_path / "film.gif"
    flags = ["--env", "Goal-Hazard-Point", "--policy", "seek", "--out", str(page)]
    main([*RENDER, *flags, "--video", str(film)])  # returns: exit status 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert "no OpenGL" in last
    assert "tried off" in last
    assert page.exists()
    assert not film.exists()


def test_without_an_encoder_there_is_a_hint(monkeypatch):
    monkeypatch.setattr(picture.importlib.util, "find_spec", lambda name: None)
    for suffix in FILMS:
        assert "autocost-jax[render]" in (picture.why_not(suffix) or "")


def test_without_opengl_worlds_are_drawn_from_above(no_gl, tmp_path, capsys):
    main(["envs", "Push-Pillar-Car", "PointGoal2", "--out", str(tmp_path)])
    out = capsys.readouterr().out
    assert "no OpenGL" in out
    assert str(tmp_path / "index.html") in out
    for name, circles in (("Push-Pillar-Car", 6), ("PointGoal2", 12)):
        root = ET.fromstring((tmp_path / f"{name}.svg").read_text())
        # Pillars, goal and caster; hazards, goal and the Point's sphere.
        assert len(root.findall(".//{*}circle")) == circles
    page = check_page((tmp_path / "index.html").read_text())
    assert page.tags.count("img") == 2


def test_top_view_puts_things_where_they_are():
    config = EnvConfig(hazards_num=1)
    shown = scene.make_scene(config)
    layout = scene.random_layout(config, jax.random.key(0))
    root = ET.fromstring(gallery.top_view(shown, scene.at_rest(shown, layout)))
    place = {(c.get("cx"), c.get("cy"), c.get("r")) for c in root.iter() if c.get("r")}
    for xy, radius in ((layout.hazards[0], "0.3"), (layout.robot_xy, "0.1")):
        assert (f"{xy[0]:.4f}", f"{xy[1]:.4f}", radius) in place


@pytest.mark.parametrize("name", [name for name in (*ENVS, *SUITE) if "Point" in name])
def test_facts_of_a_world(name):
    config = env_config(name)
    facts = gallery.env_facts(config, make_env(config))
    words = " ".join(facts.values())
    for kind in ("hazard", "pillar", "vase"):
        assert (kind in words) == bool(getattr(config, f"{kind}s_num"))
    assert ("box" in words) == (config.task == "Push")
    assert ("1 while" in facts["Cost of a step"]) == (
        config.constrain_indicator or config.constrained == ("pillars",)
    )


@pytest.mark.parametrize("suffix", FILMS)
@pytest.mark.parametrize(("steps", "dt"), [(1, 0.02), (1000, 0.02), (1000, 0.1)])
def test_films_are_short_and_run_to_the_end(steps, dt, suffix):
    frames, speed = film_frames(steps, dt, suffix)
    assert 1 <= len(frames) <= MOST_FRAMES[suffix]
    assert frames[0] == 0
    assert (np.diff(frames) >= 0).all()
    assert steps - frames[-1] <= speed / FPS[suffix] / dt + 1
    assert speed == 1 or 2 * len(frames) > MOST_FRAMES[suffix] - 2


@pytest.fixture
def gl():
    picture.find_backend.cache_clear()
    if picture.find_backend() is None:
        pytest.skip(
            "there is no OpenGL here (libegl1 + libgl1-mesa-dri, or libosmesa6)"
        )


def short_job(path, **options):
    config = dataclasses.replace(ENVS["Push-Pillar-Car"], num_steps=12)
    recording = still_recording(config, 12)
    recording.qpos[:, 0] += np.linspace(0, 0.4, 13)
    return Job(config, recording, path, size=(160, 120), **options)


@pytest.mark.slow
def test_films_and_pictures(gl, tmp_path):
    from matplotlib.image import imread
    from PIL import Image, ImageSequence

    jobs = [
        short_job(tmp_path / "film.gif", title="Car"),
        short_job(tmp_path / "film.mp4", camera="top"),
        short_job(tmp_path / "picture.png", camera="fixed"),
    ]
    picture.draw(jobs)
    image = imread(tmp_path / "picture.png")
    assert image.shape[:2] == (120, 160)
    assert (
        len(np.unique((image[..., :3] * 255).astype(int).reshape(-1, 3), axis=0)) > 99
    )
    film = Image.open(tmp_path / "film.gif")
    stills = [np.asarray(x.convert("RGB")) for x in ImageSequence.Iterator(film)]
    assert len(stills) == len(film_frames(12, 0.04, ".gif")[0])
    assert (stills[0] != stills[-1]).any()
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    assert next(reader)["size"] == (160, 120)
    assert len(list(reader)) == len(film_frames(12, 0.04, ".mp4")[0])


def test_worlds_are_photographed(gl, tmp_path, capsys):
    main(["envs", "Goal-Hazard-Doggo", "--out", str(tmp_path)])
    assert "no OpenGL" not in capsys.readouterr().out
    assert (tmp_path / "Goal-Hazard-Doggo.png").stat().st_size > 5_000
    page = check_page((tmp_path / "index.html").read_text())
    assert page.tags.count("img") == 1


def test_drawing_that_fails_says_why_in_one_line(gl, tmp_path):
    job = short_job(tmp_path / "film.gif")
    broken = job._replace(recording=job.recording._replace(qpos=np.zeros((13, 2))))
    with pytest.raises(RuntimeError, match="drawing failed: ") as error:
        picture.draw([broken])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripted_policies_act(name, key):
    """Actions of the right shape; forward is ahead, seek turns towards the goal."""
    env = make_env("Goal-Hazard-Car")
    agent = scripted_agent(name, env)
    obs = np.zeros((3, env.observation_size), np.float32)
    lidar = env.obs_slices["goal_lidar"]
    obs[0, lidar.start + 5] = obs[0, lidar.start + 6] = 0.5  # -y: straight ahead
    obs[1, lidar.start + 0] = 0.5  # to the driver's left
    obs[2, lidar.start + 4] = 0.5  # to its right
    action = np.asarray(agent.policy(agent.init(key), obs, key))
    assert action.shape == (3, 2)
    assert np.abs(action).max() <= 1
    if name == "forward":
        assert (action == 1).all()
    if name == "seek":
        # A Car turns left, counter-clockwise, by (1, -1).
        turn = action[:, 0] - action[:, 1]
        assert abs(turn[0]) < 1e-6
        assert turn[1] > 0.01
        assert turn[2] < -0.01


def test_seek_gets_closer_to_the_goal(replayed):
    assert sum_of(replayed.read_text(), "reward") > 0.2  # in a bit more than a second
