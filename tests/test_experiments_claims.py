"""The page of claims: its tests, its verdicts, and that it is of the results."""

import json
from pathlib import Path

import pytest

from scripts import load_script

RESULTS = Path(__file__).parents[1] / "experiments" / "results"
claims = load_script("experiments/claims")


def scores(violations=0, ep_return=5.0, cost=0.0, spread=0.1, episodes=1000):
    """As a figure's JSON has them."""
    steps = (-2, -1, 0, 1, 2)
    return {
        "return": {
            "mean": ep_return,
            "seeds": [ep_return + spread * step for step in steps],
        },
        "cost": {"mean": cost, "seeds": [cost + 0.01 * step for step in steps]},
        "violations": violations,
        "episodes": episodes,
        "curves": {
            "ep_total_cost": {"mean": [4.0] * 20},
            "ep_cost": {"mean": [0] * 20},
        },
    }


def write(folder: Path, world: str, designs: dict) -> None:
    """A result of a figure with these designs, the same for both algorithms."""
    panel = {
        name: {"algorithms": dict.fromkeys(("ppo_lagrangian", "cpo"), row)}
        for name, row in designs.items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "figure.json").write_text(json.dumps({"worlds": {world: panel}}))


@pytest.fixture
def judge(tmp_path):
    """Results of one world -> verdict of each claim."""

    def judged(designs):
        folder = tmp_path / "Goal-Hazard-Point" / claims.SCALE
        write(folder, "Goal-Hazard-Point", designs)
        rows = claims.judged(tmp_path, "Goal-Hazard-Point")
        return {row["claim"]: row["verdict"] for row in rows}

    return judged


MARGINS = {
    "extrinsic": scores(600, 18.0),
    "margin_1x": scores(500, 18.0),
    "margin_2x": scores(30, 8.0),
    "margin_3x": scores(0, 4.0),
    "evolved": scores(0, 8.0),
}


def test_a_claim_needs_every_result(judge):
    assert set(judge(MARGINS).values()) == {"reproduced", "not measured"}
    assert judge(MARGINS)["Margins"] == "reproduced"
    without = {name: row for name, row in MARGINS.items() if name != "margin_1x"}
    assert judge(without)["Margins"] == "not measured"
    few = MARGINS | {"margin_1x": scores(250, 18.0, episodes=500)}
    assert judge(few)["Margins"] == "not measured"


@pytest.mark.parametrize(
    ("design", "row", "expected"),
    [
        ("evolved", scores(1, 8.0), "in part"),  # one violation is not none
        ("evolved", scores(0, 5.9), "in part"),  # 1.475 times the return of 3x
        ("evolved", scores(0, 6.1), "reproduced"),
        ("margin_2x", scores(16, 8.0), "reproduced"),
        ("margin_2x", scores(15, 8.0), "in part"),  # 1.5 %: zero is not excluded
        ("margin_3x", scores(0, -2.0), "reproduced"),
    ],
)
def test_the_margins_are_held_to_the_bars(judge, design, row, expected):
    assert judge(MARGINS | {design: row})["Margins"] == expected


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (scores(600, 18.05, 1.0), "in part"),  # PPO-Lag unchanged, as the paper says
        (scores(0, -2.0, 0.0), "in part"),  # CPO at zero, PPO-Lag changed
    ],
)
def test_negative_limits(judge, row, expected):
    plain = {"extrinsic": scores(600, 18.0, 1.0), "limit_-0.1": scores(20)}
    assert judge(plain | {"limit_-1": row})["Negative limits"] == expected


@pytest.mark.parametrize(
    ("found", "other", "holds"),
    [(1.4, -2.0, False), (1.6, -2.0, True), (1.6, 1.0, True), (3.1, 2.0, True)],
)
def test_returns_about_zero_are_no_measure(found, other, holds):
    pair = [claims.Scores(scores(ep_return=value)) for value in (found, other)]
    assert claims.keeps(1.5)(*pair) == holds


def test_an_evolution_is_judged_by_all_its_seeds(tmp_path):
    costs = [[[2.0, 1.0], [1.0, 0.0]], [[1.0, 3.0], [4.0, 5.0]]]
    searches = [{"rule": "paper", "cost": cost} for cost in costs]
    searches.append({"rule": "guided", "cost": [[0.0], [0.0]]})
    (tmp_path / "evolution.json").write_text(json.dumps({"searches": searches}))
    answers = claims.evolution(tmp_path)
    assert [answer.holds for answer in answers] == [True, False, False]
    assert answers[1].measured == "0, 1; 0, 0"
    assert claims.evolution(tmp_path / "nowhere")[0].holds is None


def test_verdicts():
    assert claims.verdict([True, True]) == "reproduced"
    assert claims.verdict([True, False]) == "in part"
    assert claims.verdict([False, False]) == "not"
    assert claims.verdict([True, None]) == "not measured"
    assert claims.verdict([]) == "not measured"


def test_a_difference_within_the_spread_is_none():
    a = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert claims.includes_zero(a, [1.5, 2.5, 3.5, 4.5, 5.5])
    assert not claims.includes_zero(a, [6.0, 7.0, 8.0, 9.0, 10.0])


def test_every_design_of_a_claim_is_trained_by_a_figure():
    paper = load_script("experiments/figures")
    trained = {
        (world, design)
        for figure in paper.FIGURES
        for world in figure.worlds
        for design in figure.designs
    }
    for sentences in claims.CLAIMS.values():
        for part in sentences:
            for design in part.designs:
                assert (part.world or "Goal-Hazard-Point", design) in trained


def test_the_committed_page_is_that_of_the_results():
    result = json.loads((RESULTS / "claims.json").read_text())
    assert (RESULTS / "claims.md").read_text() == claims.table(result)
    for world, rows in result["worlds"].items():
        assert rows == claims.judged(RESULTS, world)
        assert len(rows) == 11
