"""Experiments on the search: their tables are those of their JSON, their statistics."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autocost_jax.config import AgentConfig, preset
from autocost_jax.costs import load_cost
from autocost_jax.envs.physics.models import FLOOR_CONTACTS
from autocost_jax.runs.directory import RunDir
from scripts import load_script

RESULTS = Path(__file__).parents[1] / "experiments" / "results"


@pytest.mark.parametrize(
    ("script", "folder", "rows"),
    [
        ("main_job", "main_job", None),
        ("fitness", "fitness", "rules"),
        ("learners", "learners", "settings"),
        ("starts", "starts", None),
        ("touches", "touches", "robots"),
    ],
)
def test_tables_are_those_of_the_committed_json(script, folder, rows):
    file = RESULTS / folder / f"{script}.json"
    result = json.loads(file.read_text())
    text = load_script(f"experiments/{script}").table(result[rows] if rows else result)
    assert len(text.splitlines()) > 4
    assert file.with_suffix(".md").read_text() == text


def test_measured_learners_are_those_of_the_script():
    """A setting that has been measured does not change with a preset."""
    learners = load_script("experiments/learners")
    result = json.loads((RESULTS / "learners" / "learners.json").read_text())
    assert len(result["settings"]) >= 5
    for measured in result["settings"]:
        train = learners.config_of(measured["setting"]).train
        agent = dataclasses.asdict(train.agent)
        # What was no setting yet had what is its default now.
        then = dataclasses.asdict(AgentConfig()) | measured["agent"]
        known = {name: then[name] for name in agent}
        assert known == json.loads(json.dumps(agent))
        assert measured["worlds"] == train.num_worlds


def test_a_learner_setting_is_that_of_the_laptop_preset():
    learners = load_script("experiments/learners")
    trains = [learners.config_of(name).train for name in learners.SETTINGS]
    settings = [(train.agent, train.num_worlds) for train in trains]
    laptop = preset("laptop").train
    assert (laptop.agent, laptop.num_worlds) in settings


def test_the_shipped_cost_is_one_of_the_study():
    fitness = load_script("experiments/fitness")
    theta = fitness.costs(fitness.Size())
    assert theta.shape == (48, 41)
    assert not theta[:2].any()
    np.testing.assert_allclose(theta[36], load_cost("lidar_mlp"), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(fitness.costs(fitness.SMOKE)[[2, 4]], theta[[2, 42]])


def test_costs_of_the_study_of_starts_are_those_of_the_script():
    starts = load_script("experiments/starts")
    result = json.loads((RESULTS / "starts" / "starts.json").read_text())
    labels = {*starts.PLAIN, *(starts.label_of(*cost) for cost in starts.GRID)}
    assert {row["cost"] for row in result["rows"]} == labels
    known = {field.name for field in dataclasses.fields(AgentConfig)}
    assert set(result["agent"]) <= known  # a preset's learner of that time


def test_a_stage_that_tells_the_truth_ranks_perfectly():
    """Costs from useless to unsafe, the same in every epoch and for every seed."""
    starts = load_script("experiments/starts")
    kept = np.array([1.0, 0.4, 0.0, 0.1, 0.2, 0.4, 0.9])
    left = np.array([1.0, 0.2, 0.1, 0.1, 0.1, 0.1, 0.8])
    shape = (60, 2, 7, 3)
    values = {
        "ep_return": np.broadcast_to(20 * kept[:, None], shape),
        "violating_worlds": np.broadcast_to(0.8 * left[:, None], shape),
        "ep_cost": np.broadcast_to(3.0 * left[:, None], shape),
    }
    ranks = {
        (row["rule"], row["epochs"]): row["by_seed"]
        for row in starts.rank_correlations(values)
    }
    assert ranks["distance from the aims", 36] == pytest.approx([1.0] * 3)
    assert ranks["distance, a seed for each cost", 36] == pytest.approx([1.0])
    assert max(ranks["extrinsic cost", 36]) < 0.9  # it likes useless costs
    far = starts.distance(values, 60, [0])
    assert far[3] == 0.0
    assert far[0] == pytest.approx(8.0)  # useless with both algorithms


def test_every_way_spends_as_many_epochs_and_chooses_by_its_seed():
    starts = load_script("experiments/starts")
    assert {starts.epochs_of(way) for way in starts.WAYS.values()} == {432}
    left = np.linspace(0.2, 1.0, 14)[::-1].copy()  # the last cost is the safest
    left[:2] = 1.0
    shape = (80, 2, 14, 3)
    rates = np.broadcast_to(0.8 * left[:, None], shape).copy()
    rates[:24, :, -1] = 0.8  # which shows only after 24 epochs
    values = {
        "ep_return": np.full(shape, 20.0),
        "violating_worlds": rates,
        "ep_cost": 3 * rates,
    }
    whole, halving, quarters = (
        starts.chosen(values, way, 1) for way in starts.WAYS.values()
    )
    assert (whole, halving, quarters) == (11, 10, 10)
    rows = {row["way"]: row["by_seed"] for row in starts.ways(values)}
    assert rows["all for 36 epochs"] == rows["the best of them"]
    assert rows["any of them"][0] > 1.0


def test_the_interval_of_a_fall():
    main_job = load_script("experiments/main_job")
    rng = np.random.default_rng(1)
    first, last = rng.normal(3.0, 1.0, 400), rng.normal(1.0, 1.0, 400)
    low, high = main_job.bootstrap_difference(first, last)
    assert low < first.mean() - last.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(2 / 400), rel=0.15)
    low, high = main_job.bootstrap_difference(first, first)
    assert low < 0 < high


def test_rank_correlation_is_that_of_scipy():
    from scipy.stats import spearmanr

    a, b = np.random.default_rng(2).integers(0, 6, (2, 3, 20))  # with ties
    got = load_script("experiments/fitness").spearman(a, b)
    for x, y, value in zip(a, b, got, strict=True):
        result: Any = spearmanr(x, y)
        assert value == pytest.approx(result.statistic)


def test_a_rule_reads_its_own_epochs_and_seeds():
    fitness = load_script("experiments/fitness")
    epochs = np.arange(128.0)[:, None, None, None] * np.ones((1, 2, 3, 5))
    seeds = epochs + 1000 * np.arange(5)
    arrays = {f"short/{key}": seeds for key in fitness.KEYS.values()}
    rule = fitness.Rule("short", 32, 2)
    got = fitness.judged(arrays, rule, (1, 3))["cost"]
    np.testing.assert_allclose(got, np.full((2, 3), np.mean(range(24, 32)) + 2000))
    assert rule.budget == 4000 * 32 * 2


def test_the_validation_compares_the_means_of_its_seeds(tmp_path):
    """A margin that stays short of the bar and a best cost that reaches it."""
    main_job = load_script("experiments/main_job")
    config = dataclasses.replace(preset("smoke"), algorithms=("cpo",))
    paper = main_job.search_dir(tmp_path, "paper", 1)
    RunDir.create(paper, config, {}).close()
    theta = np.arange(41.0)
    np.savez(paper / "cost.npz", theta=theta)
    table = main_job.validation_table([paper])
    labels = ["cpo extrinsic", "cpo safety_margin_3x", "cpo paper_1"]
    assert [method.label for method in table.methods] == labels
    assert table.methods[2].theta == tuple(theta)
    seeds = [seed for group in main_job.SEEDS.values() for seed in group]
    assert not set(table.seeds) & set(seeds)
    scores = {labels[0]: (0.8, 20.0), labels[1]: (0.3, 12.0), labels[2]: (0.1, 8.0)}
    rows = [
        {"method": label, "violation_rate": rate + shift, "return_mean": ep_return}
        for label, (rate, ep_return) in scores.items()
        for shift in (-0.1, 0.1)
    ]
    assert main_job.validation_rows([paper], tmp_path) == []
    (tmp_path / "evaluation.json").write_text(json.dumps({"rows": rows}))
    margin, best = main_job.validation_rows([paper], tmp_path)
    assert margin["violations_left"] == pytest.approx(0.375)
    assert best["return_kept"] == pytest.approx(0.4)
    assert [row["reached"] for row in (margin, best)] == [False, True]


def test_what_the_reduced_models_leave_out_touches_rarely():
    touches = load_script("experiments/touches")
    result = json.loads((RESULTS / "touches" / "touches.json").read_text())
    assert [found["robot"] for found in result["robots"]] == list(touches.ROBOTS)
    for found in result["robots"]:
        assert found["steps"] == touches.STEPS
        reduced = touches.reduced_pairs(found["robot"])
        for row in found["pairs"]:
            assert row["in_reduced_model"] == (frozenset(row["pair"]) in reduced)
            assert row["in_reduced_model"] or row["share"] < touches.RARE
        most = FLOOR_CONTACTS[found["robot"]]
        more = [x for n, x in found["contacts"].items() if int(n) > most]
        assert sum(more) < touches.RARE
