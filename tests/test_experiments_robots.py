"""experiments/robots.py: what it counts, and that its tables are of its results."""

import json
from pathlib import Path

import numpy as np
import pytest

from autocost_jax import TrainConfig
from autocost_jax.runs.directory import RunDir
from autocost_jax.runs.sweep import Method, SweepConfig
from scripts import load_script

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results" / "eight_hazards" / "robots"


@pytest.fixture(scope="module")
def robots():
    """The script as a module."""
    return load_script("experiments/robots")


@pytest.fixture
def run(tmp_path):
    """A run of two epochs and two seeds, of which every number is known."""
    config = SweepConfig(
        TrainConfig(num_worlds=2, num_epochs=2),
        (Method("cpo", "cpo", limit=25.0),),
        (0, 1),
    )
    zero = np.zeros(2)
    with RunDir.create(tmp_path / "limit25", config) as run:
        for epoch, (cost, case) in enumerate([([40, 20], [0, 2]), ([30, 10], [1, 2])]):
            row = {
                "ep_return": [1, 3],
                "ep_cost": cost,
                "kl": [0.01, 0.0],
                "multiplier": [2, 0],
                "case": case,
                "accepted": [1, epoch],
                "failed_worlds": zero,
                "frozen": zero,
                "intrinsic_near": [np.nan, 0.5],
            }
            named = {f"cpo/{key}": np.asarray(x) for key, x in row.items()}
            run.log_metrics(named, epoch)
    return tmp_path / "limit25"


def test_interval_over_three_seeds_is_students(robots):
    got = robots.t_interval([1.0, 2.0, 6.0])
    half = 4.302653 * np.sqrt(7.0) / np.sqrt(3.0)
    np.testing.assert_allclose(got["mean"], 3.0)
    np.testing.assert_allclose([got["low"], got["high"]], [3 - half, 3 + half], 1e-6)
    assert np.isnan(robots.t_interval([1.0])["low"])


def test_a_state_never_visited_is_no_broken_number(robots, run):
    result = robots.collect_run(run)
    assert result["non_finite_numbers"] == 0
    assert result["steps_a_slot"] == 2 * 1000 * 2
    assert [slot["ep_cost"] for slot in result["slots"]] == [[40, 30], [20, 10]]


@pytest.mark.parametrize(
    ("broken", "count"),
    [
        ({"kl": [np.nan, np.inf]}, "non_finite_numbers"),
        ({"failed_worlds": [2, 0]}, "failed_worlds"),
        ({"frozen": [1, 1]}, "frozen_slots"),
    ],
)
def test_everything_that_breaks_is_counted(robots, run, broken, count):
    file = run / "metrics.jsonl"
    first, last = map(json.loads, file.read_text().splitlines())
    with RunDir.open(run, robots.read_config(run, SweepConfig)[0]) as opened:
        opened.truncate_metrics(0)
        opened.log_metrics(first, 0)
        opened.log_metrics(last | {f"cpo/{k}": v for k, v in broken.items()}, 1)
    result = robots.collect_run(run)
    names = ("non_finite_numbers", "failed_worlds", "frozen_slots")
    expected = {name: 2 if name == count else 0 for name in names}
    assert {name: result[name] for name in names} == expected


def test_limit_summary_counts_cases_and_accepted_steps(robots, run):
    rows = [
        {"method": "cpo", "seed": seed, "cost_mean": 20.0 + seed, "return_mean": 2.0}
        for seed in (0, 1)
    ]
    text = json.dumps({"episodes": 5, "rows": rows})
    (run / "evaluation.json").write_text(text)
    row = robots.collect_limit(run)["methods"]["cpo"]
    assert row["last_cost"]["mean"] == pytest.approx(20.0)
    assert row["fresh_cost"]["mean"] == pytest.approx(20.5)
    assert row["cases"] == [0.25, 0.25, 0.5, 0.0, 0.0]
    assert row["accepted_in_case"] == [1.0, 1.0, 0.5, None, None]
    assert row["accepted"] == pytest.approx(0.75)
    assert row["multiplier"] == [1.0, 1.0, 1.0]
    assert row["kl"] == pytest.approx(0.005)


def test_innermost_lists_stand_on_one_line(robots):
    value = {"a": [1, 2.5, "NaN"], "b": [{"c": []}, [3]]}
    text = robots.compact(value)
    assert json.loads(text) == value
    assert '"a": [ 1, 2.5, "NaN" ]' in text


def test_the_tables_are_those_of_the_committed_json(robots):
    result = json.loads((RESULTS / "robots.json").read_text())
    tables = robots.render(result).strip()
    assert (RESULTS / "robots.md").read_text().strip() == tables


def test_every_committed_figure_can_be_drawn_again(robots, tmp_path):
    result = json.loads((RESULTS / "robots.json").read_text())
    robots.draw(result, tmp_path)
    drawn = {file.name for file in tmp_path.iterdir()}
    assert drawn == {file.name for file in RESULTS.glob("*.png")}
