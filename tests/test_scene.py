"""What a replay is made of: shapes, poses, lidars, and their compact form."""

import base64
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import ENVS, EnvConfig, env_config
from autocost_jax.envs.env import make_env
from autocost_jax.envs.physics.world import make_world
from autocost_jax.evaluate import first_recording, watch_first
from autocost_jax.population import make_evaluator
from autocost_jax.runs.policies import scripted_agent
from autocost_jax.viz import scene
from autocost_jax.viz.player import replay_page
from autocost_jax.viz.replay import UNKNOWN, replay_json

ROUNDING = 1e-5  # float32 kinematics and lidars in another order
NUM_STEPS = 40


def still_recording(config, steps):
    """Everything stays where it starts, for `steps` steps."""
    layout = scene.random_layout(config, jax.random.key(1))
    moment = scene.at_rest(scene.make_scene(config), layout)
    return moment._replace(
        qpos=np.repeat(moment.qpos, steps + 1, 0),
        goal_xy=np.repeat(moment.goal_xy, steps + 1, 0),
        reward=np.linspace(0, 1, steps),
        cost=np.arange(steps) % 3 * 0.5,
        constraint_lidar=np.zeros((steps, 8)),
    )


def unpack(text, dtype):
    return np.frombuffer(base64.b64decode(text), dtype)


@pytest.mark.parametrize("name", [*ENVS, "CarGoal2", "DoggoPush2"])
def test_every_geom_is_drawn(name):
    config = env_config(name)
    shown = scene.make_scene(config)
    posts = 4 * (config.task == "Push")  # of one piece with their box
    assert len(shown.shapes) == shown.model.ngeom - 1 - posts
    looks = [shape.look for shape in shown.shapes]
    assert set(looks) <= set(scene.COLOURS)
    assert "goal" in looks
    for kind in ("hazards", "pillars", "vases"):
        assert looks.count(kind) == getattr(config, f"{kind}_num")
    assert looks.count("box") == (config.task == "Push")
    robots = {shape.thing for shape in shown.shapes if shape.look in ("robot", "trim")}
    assert robots == {shown.robot}
    names = [shown.model.body(i + 1).name for i in (shown.robot, shown.goal)]
    assert names == ["robot", "goal"]


def test_the_box_and_its_posts_are_one_prism():
    outline = np.array(scene.box_outline(0.2))
    x, y = outline.T
    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
    # The square, and of each post the three quarters that stand outside it.
    assert area == pytest.approx(0.4**2 + 4 * 0.75 * 0.2**2)
    assert np.abs(outline).max() == pytest.approx(0.3)


@pytest.mark.parametrize("name", ["Push-Pillar-Point", "CarGoal1"])
def test_at_rest_is_where_an_episode_starts(name):
    config = env_config(name)
    layout = scene.random_layout(config, jax.random.key(3))
    moment = scene.at_rest(scene.make_scene(config), layout)
    world = make_world(config)
    qpos = jax.jit(lambda layout: world.place(layout).qpos)(
        jax.tree.map(jnp.asarray, layout)
    )
    np.testing.assert_allclose(moment.qpos[0], qpos, atol=ROUNDING)


@pytest.fixture(scope="module")
def episode():
    """Observations beside a recording of the same episode, and its configuration."""
    world = ENVS["Goal-Hazard-Point"]
    config = dataclasses.replace(world, num_steps=NUM_STEPS, physics="closed_form")
    env = make_env(config)
    agent = scripted_agent("seek", env)

    def watch(worlds):
        seen = {"obs": worlds.obs[0], "xy": worlds.layout.robot_xy[0]}
        return watch_first(worlds) | seen

    run = make_evaluator(env, agent, 2, keep=lambda e: e, watch=watch)
    _, episodes = run(jnp.zeros(1), jax.random.key(0))
    episodes = jax.tree.map(lambda leaf: np.asarray(leaf[0]), episodes)
    return config, env, episodes


def test_poses_and_lidars_are_those_of_the_episode(episode):
    config, env, episodes = episode
    recording = first_recording(episodes)
    replay = scene.make_replay(config, recording)
    assert replay.poses.shape[0] == NUM_STEPS + 1
    robot = replay.poses[:, replay.robot]
    np.testing.assert_allclose(robot[:, :2], episodes.watched["xy"], atol=ROUNDING)
    np.testing.assert_allclose(
        replay.poses[:, replay.goal, :2], recording.goal_xy, atol=ROUNDING
    )
    assert set(replay.lidars) == {"goal", "hazards"}
    for name, values in replay.lidars.items():
        expected = episodes.watched["obs"][:, env.obs_slices[f"{name}_lidar"]]
        np.testing.assert_allclose(values, expected, atol=ROUNDING)
    assert replay.reward[0] == replay.cost[0] == 0
    np.testing.assert_allclose(replay.reward[1:], episodes.reward[:, 0], atol=ROUNDING)
    assert replay.dt == pytest.approx(env.dt)


def test_long_episodes_are_thinned_without_losing_a_sum(monkeypatch):
    monkeypatch.setattr(scene, "MAX_FRAMES", 10)
    config = EnvConfig()
    recording = still_recording(config, 47)
    goal = recording.goal_xy.copy()
    goal[20:] += 0.5
    replay = scene.make_replay(config, recording._replace(goal_xy=goal))
    assert replay.stride == 5
    assert replay.steps == 47
    assert len(replay.poses) == 11
    assert replay.reward.sum() == pytest.approx(recording.reward.sum())
    assert replay.cost.sum() == pytest.approx(recording.cost.sum())
    assert replay.violations.sum() == (recording.cost > 0).sum()
    np.testing.assert_array_equal(replay.goals_met, [0] * 4 + [1] * 7)


def test_packed_poses_keep_a_tenth_of_a_millimetre(episode):
    config, _, episodes = episode
    replay = scene.make_replay(config, first_recording(episodes))
    data = replay_json(replay)
    json.dumps(data, allow_nan=False)
    assert replay.robot in data["moving"]
    hazards = [shape.body for shape in replay.shapes if shape.look == "hazards"]
    assert not set(hazards) & set(data["moving"])
    codes = unpack(data["poses"], "<i2").reshape(data["frames"], -1, 7)
    sent = codes * ([data["scale"]] * 3 + [1 / 32767] * 4)
    np.testing.assert_allclose(sent, replay.poses[:, data["moving"]], atol=1e-4)
    np.testing.assert_array_equal(unpack(data["cost"], "<f4"), np.float32(replay.cost))
    for body in hazards:
        np.testing.assert_allclose(
            data["still"][str(body)], replay.poses[0, body], atol=ROUNDING
        )
    bins = data["lidars"][0]["bins"]
    readings = unpack(data["lidars"][0]["values"], "u1").reshape(-1, bins) / 255
    np.testing.assert_allclose(readings, replay.lidars["goal"], atol=0.5 / 255 + 1e-9)


def test_a_failed_world_has_no_pose():
    config = EnvConfig()
    recording = still_recording(config, 9)
    recording.qpos[5:] = np.nan
    replay = scene.make_replay(config, recording)
    assert np.isnan(replay.poses[5:]).all()
    data = replay_json(replay)
    codes = unpack(data["poses"], "<i2").reshape(10, -1, 7)
    assert (codes[5:] == UNKNOWN).all()
    assert (codes[:5] != UNKNOWN).all()


def test_the_page_of_a_doggo_is_small():
    config = ENVS["Push-Pillar-Doggo"]
    recording = still_recording(config, 1000)
    wild = np.random.default_rng(0).normal(0, 0.3, recording.qpos.shape)
    recording = recording._replace(qpos=recording.qpos + np.cumsum(wild, 0))
    replay = scene.make_replay(config, recording)
    assert len(replay_page("", {}, replay)) < 600_000
