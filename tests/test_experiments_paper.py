"""The figures of the paper: what is trained, how it is counted, and one end to end."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from autocost_jax.env_config import ENVS
from scripts import ROOT, load_script

FIGURES = (
    "cost_limits",
    "negative_limits",
    "dense_cost",
    "distance_change",
    "other_tasks",
    "other_robots",
    "margins",
    "without_extrinsic",
    "total_cost",
)
paper = load_script("experiments/paper")
searches = load_script("experiments/searches")
transfer = load_script("experiments/transfer")


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_names_itself_and_what_exists(name):
    figure = load_script(f"experiments/{name}").FIGURE
    assert figure.name == name
    assert set(figure.designs) <= set(paper.DESIGNS)
    assert set(figure.worlds) <= set(ENVS)
    assert set(figure.curves) <= set(paper.AXES)
    assert f"`{name}.py`" in (ROOT / "experiments" / "README.md").read_text()


@pytest.mark.parametrize("design", paper.DESIGNS)
def test_a_design_is_trained_by_both_algorithms_with_every_seed(design):
    scale = paper.scales()["reduced"]
    config = paper.table("Goal-Pillar-Point", design, scale)
    cost = paper.DESIGNS[design]
    assert config.seeds == (0, 1, 2, 3, 4)
    assert {method.algorithm for method in config.methods} == set(cost.algorithms)
    assert {method.limit for method in config.methods} == {cost.limit}
    assert all((m.theta is None) == (cost.theta is None) for m in config.methods)
    assert config.train.env.physics == "reduced"


def test_the_scale_of_the_paper_is_its_preset():
    train = paper.table("Goal-Hazard-Point", "extrinsic", paper.scales()["paper"]).train
    assert (train.num_worlds, train.num_epochs) == (30, 333)
    assert train.agent.hidden_sizes == (256, 256)
    assert train.agent.policy_minibatches == 1


def test_the_tables_of_the_readme_are_those_of_the_results():
    text = (ROOT / "experiments" / "README.md").read_text()
    blocks = re.findall(r"<!-- (reduced/\w+) -->\n(.*?)<!-- end -->", text, re.DOTALL)
    assert {name for name, _ in blocks} >= {"reduced/evolution", "reduced/margins"}
    for name, shown in blocks:
        file = ROOT / "experiments" / "results" / f"{name}.json"
        result = json.loads(file.read_text())
        render = {"evolution": searches.render, "transfer": transfer.render}
        expect = render.get(file.stem, paper.render)(result)
        assert shown.strip() == expect.strip(), name


def row(ep_return, cost, violating, episodes=100):
    return {
        "return_mean": ep_return,
        "cost_mean": cost,
        "violation_rate": violating / episodes,
        "distance_travelled": 5.0,
        "episodes": episodes,
        "frozen_epoch": -1,
    }


def test_scores_are_over_seeds_and_violations_are_pooled():
    result = paper.summarise([row(1.0, 0.0, 0), row(3.0, 1.0, 7), row(5.0, 2.0, 3)])
    assert result["return"]["mean"] == 3.0
    assert 1.0 <= result["return"]["low"] < 3.0 < result["return"]["high"] <= 5.0
    assert (result["violations"], result["episodes"]) == (10, 300)
    assert result["violation_rate"] == pytest.approx(10 / 300)
    assert result["violation_rate_upper"] > 10 / 300


@pytest.mark.parametrize(
    ("violations", "episodes", "bound"),
    [(0, 1000, 0.002991), (0, 30, 0.0950), (1, 10, 0.3942), (10, 10, 1.0)],
)
def test_the_bound_of_a_rate(violations, episodes, bound):
    """Zero of N is about 3 / N; 1 of 10 is 0.394 in tables of the exact bound."""
    assert paper.upper_bound(violations, episodes) == pytest.approx(bound, abs=1e-4)


def test_smoothing_is_a_mean_over_the_last_epochs():
    np.testing.assert_allclose(paper.smooth([1, 3, 5, 7], width=2), [1, 2, 4, 6])


def test_a_difference_of_rates():
    """Newcombe 1998, table II, case (a): 56/70 - 48/80 is 0.0524 to 0.3339."""
    gap = transfer.rate_difference(56, 70, 48, 80)
    assert gap["mean"] == pytest.approx(0.2)
    assert gap["low"] == pytest.approx(0.0524, abs=1e-4)
    assert gap["high"] == pytest.approx(0.3339, abs=1e-4)


def test_policies_are_compared_one_by_one():
    theirs = [{"return": [1.0, 3.0], "cost": [0.0, 1.0]}] * 3
    result = transfer.compare(theirs, [row(1.5, 0.4, 50)] * 3)
    assert result["return"]["difference"]["mean"] == pytest.approx(0.5)
    assert result["cost"]["there"] == pytest.approx(0.5)
    assert result["violations"] | {"difference": None} == {
        "there": 3,
        "here": 150,
        "difference": None,
    }
    assert result["violations"]["difference"]["mean"] == pytest.approx(0.0)


def test_rules_of_the_search_differ_in_start_and_floor_alone():
    assert searches.RULES["paper"] == ()
    flags = searches.RULES["guided"][::2]
    assert flags == ("--start", "--init-std", "--return-floor")


def test_one_figure_from_training_to_picture(tmp_path):
    words = ["--smoke", "--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    for part in ("run", "run", "collect"):  # the second finds everything done
        subprocess.run(
            [sys.executable, "experiments/cost_limits.py", part, *words],
            check=True,
            cwd=ROOT,
        )
    result = json.loads((tmp_path / "cost_limits.json").read_text())
    panel = result["worlds"]["Goal-Hazard-Point"]
    assert list(panel) == ["limit_0.5", "extrinsic"]
    for trained in panel.values():
        assert set(trained["algorithms"]) == {"ppo_lagrangian", "cpo"}
        for scores in trained["algorithms"].values():
            assert scores["episodes"] == 4
            assert len(scores["curves"]["ep_cost"]["mean"]) == 2
    assert "smoke scale" in (tmp_path / "cost_limits.md").read_text()
    assert (tmp_path / "cost_limits.png").stat().st_size > 10_000
