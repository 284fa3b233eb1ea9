import dataclasses
import html
import re

import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax import report, scene
from autocost_jax.costs import intrinsic_cost
from autocost_jax.env_config import EnvConfig
from autocost_jax.scene import Recording
from pages import browse, check_page

TOL = 1e-6  # the goldens have six or seven digits
HOSTILE = "<script>alert('x')</script>\" & {{script}} $a$ </title>"
ALGORITHMS = ("ppo_lagrangian", "cpo")


def golden_theta():
    return 0.6 * (((7 * np.arange(41) + 3) % 11) - 5.0)


def make_stage(rng, size, level, zeros=0, frozen=()):
    cost = level * rng.lognormal(0.0, 0.6, (2, size))
    cost[:, :zeros] = 0.0
    returns = 4 + 6 * rng.random((2, size)) * level / (level + 1)
    cost[:, list(frozen)] = np.inf
    returns[:, list(frozen)] = -np.inf
    mean_cost = cost.mean(0)
    return report.StageRecord(
        theta=rng.normal(0, 5, (size, 41)),
        cost=mean_cost,
        ep_return=returns.mean(0),
        algorithm_cost=cost,
        algorithm_return=returns,
        zero_violation=mean_cost <= 0,
        elites=np.argsort(mean_cost)[:2],
        far_cost=np.where(rng.random(size) < 0.2, np.nan, rng.random(size)),
        near_cost=rng.random(size),
        distance_travelled=rng.gamma(1.2, 3.0, (2, size)),
    )


def make_curve(rng, stage, algorithm, size, level, epochs=24):
    decay = np.exp(-np.arange(epochs) / 8)[:, None]
    cost = level * (1 + 4 * decay) * rng.lognormal(0, 0.4, (epochs, size))
    ep_return = 10 * (1 - decay) + rng.normal(0, 1, (epochs, size))
    ep_return[epochs // 2 :, -1] = np.nan
    total = cost + 30 * rng.random(size)
    return report.Curve(stage, algorithm, np.arange(epochs), ep_return, cost, total)


def make_recording(steps=1000):
    """The Point drives a loop through four hazards; the goal moves twice."""
    t = np.linspace(0, 1, steps + 1)
    xy = np.stack([1.5 * np.cos(9 * t) * (0.6 + 0.4 * t), 1.4 * np.sin(7 * t)], -1)
    velocity = np.gradient(xy, axis=0)
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
    hazards = np.array([[1.0, 0.9], [-1.2, 0.4], [0.1, -1.0], [-0.4, 1.5]])
    offset = hazards - xy[:, None]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    ego = np.stack(
        [
            cos * offset[..., 0] + sin * offset[..., 1],
            cos * offset[..., 1] - sin * offset[..., 0],
        ],
        -1,
    )
    goals = np.array([[0.5, 1.2], [-1.4, -1.2], [1.6, -0.4]])
    cost = np.maximum(0, 0.3 - np.hypot(*np.moveaxis(offset, -1, 0))).sum(1)
    return Recording(
        qpos=np.concatenate([xy, yaw[:, None]], 1),
        goal_xy=goals[(3 * t).astype(int).clip(0, 2)],
        hazards=hazards,
        pillars=np.zeros((0, 2)),
        reward=np.full(steps, 8 / steps),
        cost=cost[1:],
        constraint_lidar=report.object_lidar(ego).max(1)[1:],
    )


def make_replay(theta, steps=1000):
    recording = make_recording(steps)
    return scene.make_replay(
        EnvConfig(hazards_num=4),
        recording,
        intrinsic=report.network_cost(theta, recording.constraint_lidar),
        label="PPO-Lagrangian, sampled actions",
    )


def steep_theta():
    """A network that is near zero far away and rises close to a hazard."""
    theta = np.zeros(41)
    theta[:32] = np.tile([14.0, 11.0, 12.5, 9.0], 8)
    theta[32:36] = [-10.5, -8.0, -9.3, -7.0]
    theta[36:40], theta[40] = 2.4, -6.0
    return theta


def make_data(size=8, zero=True, **changes):
    rng = np.random.default_rng(0)
    levels = (9.0, 4.0, 1.4, 0.7)
    stages = tuple(
        make_stage(rng, size, level, zeros=number if zero else 0, frozen=(size - 1,))
        for number, level in enumerate(levels)
    )
    index = 0 if zero else int(np.argmin(stages[3].cost))
    data = report.ReportData(
        title="Goal-Hazard-Point, laptop",
        config={
            "environment": "Goal-Hazard-Point",
            "preset": "laptop",
            "population": str(size),
            "env steps": "9.2e6",
            "duration": "8 min 12 s",
            "steps/s": "18,700",
            "device": "cpu, 2 cores",
        },
        algorithms=ALGORITHMS,
        deterministic=False,
        obstacle="hazard",
        obstacle_radius=0.3,
        stages=stages,
        best=report.BestCandidate(
            3,
            index,
            steep_theta(),
            "zero violation, highest return" if zero else "lowest cost",
            ("far: 0.002", "near: 0.31"),
        ),
        curves=tuple(
            make_curve(rng, number, name, size, level)
            for number, level in enumerate(levels)
            for name in ALGORITHMS
        ),
        control_cost=np.array([9.0, 8.1, 8.8, 7.9]),
        replay=make_replay(steep_theta()),
        evaluations=(report.Evaluation("best, CPO", 7.2, 0.4, 0.0, 0.0, 0.0, 100),),
    )
    return dataclasses.replace(data, **changes)


def best_of(data):
    assert data.best is not None
    return data.best


def test_network_golden():
    # spec algorithms.md 5.1; its e_3 is the third unit vector, counted from 1
    theta = golden_theta()
    one = np.array([0, 0.2, 0.9, 0.4, 0, 0, 0, 0.1])
    got = report.network_cost(
        theta, np.stack([np.zeros(8), one, np.eye(8)[2], np.ones(8)])
    )
    expected = [0.3595359, 0.2230037, 0.4558284, 0.3534252]
    np.testing.assert_allclose(got, expected, atol=TOL)


def test_the_nearest_network_is_that_of_the_costs():
    theta, lidar = np.linspace(-2, 1, 13), np.linspace(0, 1, 24).reshape(3, 8)
    got = report.network_cost(theta, lidar)
    expected = intrinsic_cost(jnp.asarray(theta), jnp.asarray(lidar))
    np.testing.assert_allclose(got, expected, atol=TOL)
    assert np.ptp(got) > 0.01


def test_network_is_finite_for_huge_parameters():
    with np.errstate(all="raise", under="ignore"):
        got = report.network_cost(1e6 * golden_theta(), np.full(8, 0.5))
    assert 0 <= got <= 1


def test_lidar_golden():
    offset = np.array([[1.0, 0.5], [-0.4, 0.9], [0.3, -1.5]]) - [0.3, -0.2]
    cos, sin = np.cos(0.7), np.sin(0.7)
    ego = offset @ np.array([[cos, -sin], [sin, cos]])
    expected = [
        0.371595, 0.271487, 0.225420, 0, 0.242899, 0.272532, 0.029633, 0.331191,
    ]  # fmt: skip
    np.testing.assert_allclose(report.object_lidar(ego).max(0), expected, atol=TOL)


def test_lidar_turns_with_the_robot():
    angle = 0.3 + np.arange(8) * np.pi / 4
    ego = np.stack([np.cos(angle), np.sin(angle)], -1)
    lidar = report.object_lidar(ego)
    for turn in range(8):
        np.testing.assert_allclose(lidar[turn], np.roll(lidar[0], turn), atol=1e-12)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"replay": None, "evaluations": (), "control_cost": None, "curves": ()},
        {"stages": (), "best": None},
        {"stages": (), "best": None, "curves": (), "replay": None},
        {"config": {}, "deterministic": True, "best": None},
    ],
)
def test_page_is_self_contained(changes):
    text = report.render_report(make_data(**changes))
    page = check_page(text)
    assert ("canvas" in page.tags) == ("replay" not in changes)
    assert "{{" not in text
    shown = re.sub(r"<script>.*", "", text, flags=re.DOTALL)
    assert not re.search(r"\b(nan|NaN|inf|Infinity)\b", shown)


def test_all_candidates_may_diverge():
    stage = make_stage(np.random.default_rng(1), 3, 2.0, frozen=(0, 1, 2))
    data = make_data(stages=(stage, stage), best=None)
    check_page(report.render_report(data))
    assert "every candidate of a stage diverged" in report.verdict(data)


def test_non_finite_replay_stays_strict_json():
    recording = make_recording(20)
    recording.qpos[12:], recording.reward[4] = np.nan, np.inf
    intrinsic = np.full(20, np.nan)
    replay = scene.make_replay(EnvConfig(hazards_num=4), recording, intrinsic=intrinsic)
    check_page(report.render_report(make_data(replay=replay)))


def test_the_obstacle_has_its_name():
    text = report.render_report(make_data(obstacle="pillar", replay=None))
    assert "single pillar" in text
    assert "lidar of the pillars only" in text
    assert "hazard" not in text.split("<style>")[0] + text.split("</style>")[1]


def test_text_is_escaped():
    data = make_data(
        title=HOSTILE, config={HOSTILE: HOSTILE, "duration": HOSTILE},
        algorithms=(HOSTILE, "cpo"), curves=(), deterministic=True,
    )  # fmt: skip
    best = dataclasses.replace(best_of(data), card=(HOSTILE,))
    curve = make_curve(np.random.default_rng(0), 0, HOSTILE, 8, 1.0)
    replay = dataclasses.replace(make_replay(steep_theta()), label=HOSTILE)
    row = report.Evaluation(HOSTILE, 1, 1, 1, 1, 0.5, 10)
    text = report.render_report(
        dataclasses.replace(
            data, best=best, replay=replay, curves=(curve,), evaluations=(row,)
        )
    )
    page = check_page(text)
    assert page.title.startswith(HOSTILE)
    assert page.tags.count("script") == 2
    assert "<script>alert" not in text
    assert html.escape(HOSTILE) in text


def test_verdict_says_what_was_reached():
    data = make_data()
    text = report.verdict(data)
    assert "zero-violation candidate with the highest return" in text
    assert "candidate 0 of stage 4" in text
    assert "from 0 of 8 to 3 of 8" in text
    none = report.verdict(make_data(zero=False))
    assert "no candidate of the search reached zero violations" in none
    assert "highest return" not in none


def test_small_costs_do_not_read_as_zero():
    data = make_data(zero=False)
    data.stages[3].cost[2] = 4e-4
    best = dataclasses.replace(best_of(data), index=2)
    assert "extrinsic cost 0.0004" in report.verdict(
        dataclasses.replace(data, best=best)
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": 99}, r"best\.index"),
        ({"stage": 9}, r"best\.stage"),
        ({"theta": np.zeros(40)}, r"best\.theta"),
    ],
)
def test_wrong_best_is_refused(change, message):
    data = make_data()
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(data, best=dataclasses.replace(best_of(data), **change))


def test_wrong_shapes_are_refused():
    data = make_data()
    stage = dataclasses.replace(data.stages[0], algorithm_cost=np.zeros((3, 8)))
    with pytest.raises(ValueError, match=r"stages\[0\]\.algorithm_cost"):
        dataclasses.replace(data, stages=(stage,), best=None)
    curve = dataclasses.replace(data.curves[0], algorithm="sac")
    with pytest.raises(ValueError, match="ppo_lagrangian, cpo"):
        dataclasses.replace(data, curves=(curve,))
    with pytest.raises(ValueError, match=r"replay\.reward"):
        dataclasses.replace(make_replay(steep_theta(), 9), reward=np.zeros(3))


def test_paper_sized_report_is_small_and_repeatable(tmp_path):
    rng = np.random.default_rng(2)
    data = make_data(
        stages=tuple(make_stage(rng, 50, 3.0, frozen=(1,)) for _ in range(7)),
        best=None,
        curves=tuple(
            make_curve(rng, stage, name, 50, 3.0, epochs=333)
            for stage in range(7)
            for name in ALGORITHMS
        ),
    )
    path = report.write_report(data, tmp_path / "report" / "index.html")
    assert path.stat().st_size < 2_000_000
    assert path.read_text(encoding="utf-8") == report.render_report(data)


def test_figures_save_as_png(tmp_path):
    data = make_data(zero=False)
    for name, figure, panels in (
        ("stages", report.stage_scatter(data), 3),
        ("curves", report.learning_curves(data), 3),
        ("heat", report.heat_map(steep_theta(), 0.3), 3),  # one is the colour bar
    ):
        assert len(figure.axes) == panels
        figure.savefig(tmp_path / f"{name}.png", dpi=60)
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000


def test_browser_plays_the_replay(tmp_path):
    page = report.write_report(make_data(title=HOSTILE), tmp_path / "index.html")
    dom, log = browse(tmp_path, page)
    assert 'data-ready="true"' in dom
    frame = re.search(r'<canvas id="world"[^>]*data-frame="(\d+)"', dom)
    assert frame is not None
    assert int(frame.group(1)) > 5
    assert re.search(r'id="now-return">-?\d+\.\d\d<', dom)
    assert "CONSOLE" not in log
    assert "ERR_" not in log


def test_browser_opens_a_report_without_replay(tmp_path):
    data = make_data(replay=None, stages=(), best=None)
    dom, log = browse(tmp_path, report.write_report(data, tmp_path / "index.html"))
    assert 'data-ready="true"' in dom
    assert "CONSOLE" not in log


def test_browser_log_would_show_an_error(tmp_path):
    """The check above is not vacuous: a broken page does reach the log."""
    page = tmp_path / "broken.html"
    page.write_text("<!DOCTYPE html><script>missing()</script>", encoding="utf-8")
    _, log = browse(tmp_path, page)
    assert "CONSOLE" in log
