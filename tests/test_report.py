import dataclasses
import functools
import html
import json
import re

import numpy as np
import pytest

from autocost_jax.config import EnvConfig
from autocost_jax.evaluate import Recording
from autocost_jax.viz import cost_map, report, scene
from autocost_jax.viz.diagnosis import describe_cost, side_costs
from autocost_jax.viz.player import (
    first_pair,
    outside_share,
    replay_summary,
)
from autocost_jax.viz.tradeoff import candidates, front
from pages import browse, check_page

TOL = 1e-6  # the goldens have six or seven digits
HOSTILE = "<script>alert('x')</script>\" & {{script}} $a$ </title>"
ALGORITHMS = ("ppo_lagrangian", "cpo")


@pytest.fixture
def drawn():
    """For tests that look at the figures, too, or at what the page must not say."""


@pytest.fixture(autouse=True)
def bare_figures(request, monkeypatch):
    """What a page says is tested without its figures, which take seconds to draw."""
    if "drawn" not in request.fixturenames:
        bare = "<svg></svg>"
        monkeypatch.setattr("autocost_jax.viz.svg.panel_svg", lambda *_, **__: bare)


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
        judged=mean_cost,
        ep_return=returns.mean(0),
        algorithm_cost=cost,
        algorithm_return=returns,
        zero_violation=mean_cost <= 0,
        elites=np.argsort(mean_cost)[:2],
        far_cost=np.where(rng.random(size) < 0.2, np.nan, rng.random(size)),
        near_cost=rng.random(size),
        violation_rate=np.clip(mean_cost / 10 * rng.random((2, size)), 0, 1),
        outside_share=rng.random((2, size)) ** 4,
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
        constraint_lidar=cost_map.object_lidar(ego).max(1)[1:],
    )


def make_replay(theta, steps=1000, label="CPO, best cost"):
    recording = make_recording(steps)
    return scene.make_replay(
        EnvConfig(hazards_num=4),
        recording,
        intrinsic=cost_map.network_cost(theta, recording.constraint_lidar),
        label=label,
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
        summary=make_summary(),
        conclusion="The search succeeded: no violations at 80 % of the return.",
        references=make_references(len(stages)),
        replays=(make_replay(steep_theta()),),
    )
    return dataclasses.replace(data, **changes)


@functools.cache
def drawn_page():
    """The page of `make_data()`; drawn once, for tests that ask for `drawn`."""
    return report.render_report(make_data())


def make_summary(best_rate=0.0, outside=0.0):
    """Fresh scores of both algorithms under the three costs."""
    scores = {
        "extrinsic": (9.0, 11.2, 0.92, 0.01),
        "safety_margin_3x": (6.1, 0.4, 0.11, 0.02),
        "best": (7.2, 0.0, best_rate, outside),
    }
    return tuple(
        report.SummaryRow(name, cost, *row, seeds=5, episodes=100)
        for name in ALGORITHMS
        for cost, row in scores.items()
    )


def make_references(stages):
    rng = np.random.default_rng(3)
    return tuple(
        report.ReferenceScore(
            stage, name, cost, level + rng.random(), 10 * rate, rate, 0.02
        )
        for stage in range(stages)
        for name in ALGORITHMS
        for cost, level, rate in (("extrinsic", 8, 0.9), ("safety_margin_3x", 5, 0.15))
    )


def best_of(data):
    assert data.best is not None
    return data.best


def test_network_is_finite_for_huge_parameters():
    got = cost_map.network_cost(1e6 * golden_theta(), np.full(8, 0.5))
    assert 0 <= got <= 1


def test_lidar_golden():
    offset = np.array([[1.0, 0.5], [-0.4, 0.9], [0.3, -1.5]]) - [0.3, -0.2]
    cos, sin = np.cos(0.7), np.sin(0.7)
    ego = offset @ np.array([[cos, -sin], [sin, cos]])
    expected = [
        0.371595, 0.271487, 0.225420, 0, 0.242899, 0.272532, 0.029633, 0.331191,
    ]  # fmt: skip
    np.testing.assert_allclose(cost_map.object_lidar(ego).max(0), expected, atol=TOL)


def test_lidar_turns_with_the_robot():
    angle = 0.3 + np.arange(8) * np.pi / 4
    ego = np.stack([np.cos(angle), np.sin(angle)], -1)
    lidar = cost_map.object_lidar(ego)
    for turn in range(8):
        np.testing.assert_allclose(lidar[turn], np.roll(lidar[0], turn), atol=1e-6)


@pytest.mark.usefixtures("drawn")
def test_page_with_figures_is_self_contained():
    assert_self_contained(drawn_page(), canvas=True)


@pytest.mark.parametrize(
    "changes",
    [
        {"replays": (), "summary": (), "references": (), "curves": ()},
        {"stages": (), "best": None, "conclusion": ""},
        {"stages": (), "best": None, "curves": (), "replays": ()},
        {"can_violate": False, "conclusion": ""},
        {"config": {}, "deterministic": True, "best": None},
    ],
)
def test_page_is_self_contained(changes):
    text = report.render_report(make_data(**changes))
    assert_self_contained(text, canvas="replays" not in changes)


def assert_self_contained(text, canvas):
    page = check_page(text)
    assert ("canvas" in page.tags) == canvas
    assert "{{" not in text
    shown = re.sub(r"<script>.*", "", text, flags=re.DOTALL)
    assert not re.search(r"\b(nan|NaN|inf|Infinity)\b", shown)


@pytest.mark.usefixtures("drawn")
def test_all_candidates_may_diverge():
    stage = make_stage(np.random.default_rng(1), 3, 2.0, frozen=(0, 1, 2))
    data = make_data(stages=(stage, stage), best=None, conclusion="")
    check_page(report.render_report(data))
    assert "Every candidate of a stage diverged" in report.verdict(data)


def test_non_finite_replay_stays_strict_json():
    recording = make_recording(50)
    recording.qpos[12:], recording.reward[4] = np.nan, np.inf
    intrinsic = np.full(50, np.nan)
    replay = scene.make_replay(EnvConfig(hazards_num=4), recording, intrinsic=intrinsic)
    check_page(report.render_report(make_data(replays=(replay,))))


@pytest.mark.usefixtures("drawn")
def test_the_obstacle_has_its_name():
    text = report.render_report(make_data(obstacle="pillar", replays=()))
    assert "single pillar" in text
    assert "lidar of the pillars only" in text
    assert "hazard" not in text.split("<style>")[0] + text.split("</style>")[1]


@pytest.mark.usefixtures("drawn")
def test_text_is_escaped():
    data = make_data(
        title=HOSTILE, config={HOSTILE: HOSTILE, "duration": HOSTILE},
        algorithms=(HOSTILE, "cpo"), curves=(), references=(), summary=(),
        deterministic=True,
    )  # fmt: skip
    best = dataclasses.replace(best_of(data), card=(HOSTILE,))
    curve = make_curve(np.random.default_rng(0), 0, HOSTILE, 8, 1.0)
    replay = dataclasses.replace(make_replay(steep_theta()), label=HOSTILE)
    rows = (report.SummaryRow(HOSTILE, "best", 1.0, 0.0, 0.5, 0.5, 1, 10),)
    text = report.render_report(
        dataclasses.replace(
            data,
            best=best,
            replays=(replay, replay),
            curves=(curve,),
            summary=rows,
            conclusion=HOSTILE,
        )
    )
    page = check_page(text)
    assert page.title.startswith(HOSTILE)
    assert page.tags.count("script") == 2
    assert "<script>alert" not in text
    assert html.escape(HOSTILE) in text


def text_of(page, section):
    """The words of a section of the page."""
    found = re.search(rf'<section id="{section}".*?</section>', page, re.DOTALL)
    assert found is not None, section
    words = re.sub(r"<svg.*?</svg>", " ", found.group(0), flags=re.DOTALL)
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", words)))


def rows_of(page, section):
    """The cells of the table rows of a section."""
    found = re.search(rf'<section id="{section}".*?</section>', page, re.DOTALL)
    assert found is not None, section
    return [
        re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        for row in re.findall(r"<tr.*?</tr>", found.group(0), re.DOTALL)
    ]


@pytest.mark.usefixtures("drawn")
def test_the_page_begins_with_the_outcome():
    page = drawn_page()
    order = ("outcome", "tradeoff", "replay", "best", "evolution", "learning")
    places = [page.index(f'<section id="{name}"') for name in (*order, "stages")]
    assert places == sorted(places)
    head = page[: places[0]]
    assert "The search succeeded: no violations at 80 % of the return." in head
    rows = rows_of(page, "outcome")
    assert rows[0][1:3] == [
        "PPO-Lagrangian: return",
        "PPO-Lagrangian: violating episodes",
    ]
    assert rows[1:] == [
        ["extrinsic cost alone", "9", "92 %", "9", "92 %", "5 x 100"],
        ["3x margin by hand", "6.1", "11 %", "6.1", "11 %", "5 x 100"],
        ["best cost found", "7.2", "0 %", "7.2", "0 %", "5 x 100"],
    ]
    assert page.count('<tr class="zero"><th scope="row">best cost found') == 1
    assert "leave the arena" not in text_of(page, "outcome")


def test_a_cost_that_drives_agents_out_is_found_out():
    page = report.render_report(make_data(summary=make_summary(0.0, outside=0.81)))
    words = text_of(page, "outcome")
    assert "With the best cost found agents leave the arena" in words
    assert "CPO 81 % of their time" in words


def test_unknown_scores_are_dashes():
    rows = (report.SummaryRow("cpo", "best", 3.0),)
    page = report.render_report(make_data(summary=rows))
    assert rows_of(page, "outcome")[1] == [
        "best cost found", "–", "–", "3", "–", "–",
    ]  # fmt: skip


def test_without_fresh_scores_the_page_claims_no_success():
    data = make_data(conclusion="", summary=())
    text = report.verdict(data)
    assert "candidate 1 of stage 4" in text
    assert "3 of its 8 candidates had no violation" in text
    assert "does not tell whether the search succeeded" in text
    assert 'id="outcome"' not in report.render_report(data)


@pytest.mark.usefixtures("drawn")
def test_short_episodes_say_nothing_about_safety():
    page = report.render_report(make_data(can_violate=False, conclusion=""))
    shown = page.split("</style>")[1].split("<footer")[0]
    assert "episodes of this run are too short to judge safety" in shown
    assert rows_of(page, "outcome")[3][2] == "episodes too short"
    assert 'id="tradeoff"' not in page
    assert '<tr class="zero"' not in page
    for claim in ("zero violation", "had no violation", "no violation</text>"):
        assert claim not in shown
    claims = drawn_page()
    assert '<tr class="zero"' in claims
    assert "zero violation" in claims


def test_people_count_candidates_from_one():
    data = make_data()
    page = report.render_report(data)
    assert "Candidate 1 of stage 4" in text_of(page, "best")
    rows = rows_of(page, "stages")
    selected = ", ".join(str(i + 1) for i in data.stages[0].elites)
    assert rows[1][0] == "1"
    assert rows[1][-1] == selected
    names = [row[0] for row in rows if "/" in row[0] and row[0][0].isdigit()]
    assert names == [f"{s} / {i}" for s in range(1, 5) for i in range(1, 9)]


@pytest.mark.usefixtures("drawn")
def test_nobody_is_called_timid():
    assert "timid" not in drawn_page().lower()


@pytest.mark.parametrize(
    ("rate", "ep_return", "expected"),
    [
        ([0.5, 0.0, 0.2, 0.2], [9.0, 3.0, 5.0, 6.0], [1, 3, 0]),
        ([0.0, 0.0, 0.4], [2.0, 7.0, 7.0], [1]),  # a tie in return is beaten
        ([], [], []),
    ],
)
def test_the_front_holds_what_nothing_beats(rate, ep_return, expected):
    got = front(np.array(rate), np.array(ep_return))
    assert got.tolist() == expected


def test_the_tradeoff_shows_every_agent_and_reference():
    data = make_data()
    rate, ep_return, stage = candidates(data, 1)
    assert len(rate) == 4 * 7  # one of each stage's eight is frozen
    known = data.stages[2].finite
    assert data.stages[2].violation_rate is not None
    np.testing.assert_array_equal(
        rate[stage == 2], data.stages[2].violation_rate[1][known]
    )
    np.testing.assert_array_equal(
        ep_return[stage == 2], data.stages[2].algorithm_return[1][known]
    )
    figure = report.tradeoff_figure(data)
    axes = figure.axes[0]
    texts = [text.get_text() for text in axes.texts]
    assert texts == ["extrinsic cost alone", "3x margin by hand"]
    without = report.tradeoff_figure(make_data(references=()))
    assert not without.axes[0].texts


def one_sided_theta(bins):
    """A network that hears these bins of the lidar alone."""
    theta = np.zeros(41)
    theta[:32].reshape(8, 4)[list(bins)] = 8.0
    theta[32:36], theta[36:40], theta[40] = -4.0, 3.0, -5.0
    return theta


def nearest_theta():
    theta = np.zeros(13)
    theta[:4], theta[4:8], theta[8:12], theta[12] = 14.0, -9.0, 2.4, -6.0
    return theta


@pytest.mark.parametrize(
    ("theta", "far", "near", "words"),
    [
        (one_sided_theta((1, 2)), 0.001, 0.3, ["One-sided", "on its left"]),
        (one_sided_theta((3, 4)), 0.001, 0.3, ["One-sided", "behind it"]),
        (nearest_theta(), 0.2, 0.5, ["Loud everywhere: 0.2 per step"]),
        (nearest_theta(), 0.001, 0.02, ["Silent", "0.02 per step"]),
        (nearest_theta(), 0.001, 0.4, ["Quiet far from hazards (0.001", "0.4 per"]),
        (nearest_theta(), np.nan, np.nan, ["Unknown close by", "Unknown far away"]),
        (one_sided_theta((6,)), 0.3, 0.01, ["One-sided", "Loud", "Silent"]),
    ],
)
def test_what_is_wrong_with_a_cost(theta, far, near, words):
    text = " ".join(describe_cost(theta, 0.3, far, near, heading=0.0))
    for word in words:
        assert word in text
    for fault in ("One-sided", "Loud everywhere", "Silent", "Quiet far"):
        expected = any(word.startswith(fault.split()[0]) for word in words)
        assert (fault in text) == expected, text


def test_sides_turn_with_the_robots_heading():
    """A Car drives along -y of its frame: its x axis points to the driver's left."""
    theta = one_sided_theta((7, 0))
    assert side_costs(theta, 0.45)[0][1] == "towards +x of its frame"
    loud, quiet = side_costs(theta, 0.45, 0.0)
    assert loud[1] == "ahead of it"
    assert quiet[0] < 0.2 * loud[0]
    turned, _ = side_costs(theta, 0.45, -np.pi / 2)
    assert turned == (pytest.approx(loud[0]), "on its left")


def test_the_page_says_what_is_wrong_with_its_best_cost():
    data = make_data(zero=False)
    best = dataclasses.replace(best_of(data), theta=one_sided_theta((1, 2)))
    page = report.render_report(dataclasses.replace(data, best=best))
    assert "One-sided: loud on one side" in text_of(page, "best")


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (["CPO, extrinsic cost alone", "CPO, best cost"], (1, 0)),
        (
            ["PPO-Lagrangian, extrinsic cost alone", "PPO-Lagrangian, best cost",
             "CPO, extrinsic cost alone", "CPO, best cost"],
            (1, 0),
        ),
        (["CPO, best cost", "CPO, 3x margin", "CPO, extrinsic cost alone"], (0, 2)),
        (["a", "b"], (0, 1)),
    ],
)  # fmt: skip
def test_the_best_cost_is_shown_first_beside_the_reference(labels, expected):
    assert first_pair(labels) == expected


def test_a_comparison_needs_two_episodes(tmp_path):
    one, path = make_replay(steep_theta(), 50), tmp_path / "new" / "page.html"
    with pytest.raises(ValueError, match="at least two, got 1"):
        report.write_comparison([one], "", "", path)
    empty = dataclasses.replace(make_replay(steep_theta(), 50), steps=0)
    with pytest.raises(ValueError, match="at least one step"):
        report.write_comparison([one, empty], "", "", path)
    assert not path.exists()


def test_a_comparison_is_one_page(tmp_path):
    lengths = {"a": 50, "b": 100}
    pair = [make_replay(steep_theta(), n, label) for label, n in lengths.items()]
    text = f"First {HOSTILE}.\n\nSecond."
    path = report.write_comparison(pair, HOSTILE, text, tmp_path / "a" / "page.html")
    page = check_page(path.read_text())
    assert page.title.startswith(HOSTILE)
    assert page.tags.count("canvas") == 4
    assert path.read_text().count("<p>Second.</p>") == 1
    rows = json.loads(page.blocks[0])
    assert [row["label"] for row in rows] == ["a", "b"]


def test_small_costs_do_not_read_as_zero():
    data = make_data(zero=False, conclusion="")
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
    row = dataclasses.replace(data.summary[0], cost="found")
    with pytest.raises(ValueError, match=r"summary\[0\]\.cost must be one of ext"):
        dataclasses.replace(data, summary=(row,))
    reference = dataclasses.replace(data.references[0], cost="best")
    with pytest.raises(ValueError, match=r"references\[0\]\.cost"):
        dataclasses.replace(data, references=(reference,))
    with pytest.raises(ValueError, match=r"replay\.reward"):
        dataclasses.replace(make_replay(steep_theta(), 50), reward=np.zeros(3))


@pytest.mark.usefixtures("drawn")
@pytest.mark.slow
def test_paper_sized_report_is_small_and_repeatable(tmp_path):
    rng = np.random.default_rng(2)
    data = make_data(
        stages=tuple(make_stage(rng, 50, 3.0, frozen=(1,)) for _ in range(7)),
        best=None,
        replays=(make_replay(steep_theta()),) * 6,
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
        ("tradeoff", report.tradeoff_figure(data), 4),  # with two colour bars
        ("heat", report.heat_map(steep_theta(), 0.3), 3),  # one is the colour bar
    ):
        assert len(figure.axes) == panels
        figure.savefig(tmp_path / f"{name}.png", dpi=60)
        assert (tmp_path / f"{name}.png").stat().st_size > 5_000


def frame_of(dom, pane=0):
    found = re.search(rf'id="world-{pane}"[^>]*data-frame="(\d+)"', dom)
    assert found is not None
    return int(found.group(1))


@pytest.mark.usefixtures("drawn")
def test_browser_plays_the_replay(tmp_path):
    page = report.write_report(make_data(title=HOSTILE), tmp_path / "index.html")
    dom, log = browse(tmp_path, page)
    assert 'data-ready="true"' in dom
    assert frame_of(dom) > 5
    assert re.search(r'id="now-return-0">-?\d+\.\d\d<', dom)
    assert "CONSOLE" not in log
    assert "ERR_" not in log


def test_one_slider_moves_two_replays(tmp_path):
    """The shorter episode waits at its end; both say where they are."""
    pair = [
        make_replay(steep_theta(), 50, "CPO, best cost"),
        make_replay(steep_theta(), 100, "CPO, extrinsic cost alone"),
    ]
    page = report.write_comparison(pair, "Two", "", tmp_path / "two.html")
    dom, log = browse(tmp_path, page, address="#step=25")
    assert (frame_of(dom, 0), frame_of(dom, 1)) == (25, 25)
    dom, log = browse(tmp_path, page, address="#step=70")
    assert (frame_of(dom, 0), frame_of(dom, 1)) == (50, 70)
    assert 'id="now-step">step 70 of 100<' in dom
    assert "CONSOLE" not in log


def test_a_fleeing_robot_is_followed_and_called_outside(tmp_path):
    recording = make_recording(50)
    recording.qpos[:, 0] += np.linspace(0, 25, 51)
    replay = scene.make_replay(EnvConfig(hazards_num=4), recording, label="a, best")
    assert outside_share(replay) > 0.8
    assert "of the time outside the arena" in replay_summary(replay)
    inside = make_replay(steep_theta(), 50)
    assert outside_share(inside) == 0
    page = report.write_comparison([replay, inside], "", "", tmp_path / "flee.html")
    dom, log = browse(tmp_path, page, address="#step=50")
    away = re.search(r'id="now-outside-0">([\d.]+) m<', dom)
    assert away is not None
    x = recording.qpos[-1, 0]
    assert float(away.group(1)) == pytest.approx(x - replay.extents[2], abs=0.06)
    assert re.search(r'id="world-0"[^>]*data-view="follow"', dom)
    assert "CONSOLE" not in log


@pytest.mark.usefixtures("drawn")
@pytest.mark.slow
def test_browser_opens_a_report_without_replay(tmp_path):
    data = make_data(replays=(), stages=(), best=None)
    dom, log = browse(tmp_path, report.write_report(data, tmp_path / "index.html"))
    assert 'data-ready="true"' in dom
    assert "CONSOLE" not in log


@pytest.mark.usefixtures("drawn")
@pytest.mark.slow
def test_browser_log_would_show_an_error(tmp_path):
    """The check above is not vacuous: a broken page does reach the log."""
    page = tmp_path / "broken.html"
    page.write_text("<!DOCTYPE html><script>missing()</script>", encoding="utf-8")
    _, log = browse(tmp_path, page)
    assert "CONSOLE" in log
