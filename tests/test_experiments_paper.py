"""The figures of the paper: what is trained, how it is counted, and one end to end."""

import dataclasses
import json
import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import ENVS
from autocost_jax.costs import total_cost
from autocost_jax.records import CostInputs
from autocost_jax.runs.directory import RunDir
from scripts import ROOT, load_script

common = load_script("experiments/common")
computing_time = load_script("experiments/computing_time")
paper = load_script("experiments/paper")
FIGURES = {f.name: f for f in load_script("experiments/figures").FIGURES}
shapes = load_script("experiments/shapes")
transfer = load_script("experiments/transfer")
CROWDED = ROOT / "experiments" / "results" / "eight_hazards"


def test_figures_name_what_exists():
    page = (ROOT / "experiments" / "README.md").read_text()
    assert len(FIGURES) == 9
    for name, figure in FIGURES.items():
        assert set(figure.designs) <= set(paper.DESIGNS), name
        assert set(figure.worlds) <= set(ENVS), name
        assert set(figure.curves) <= set(paper.AXES), name
        assert f"`figures.py` {name} |" in page


@pytest.mark.parametrize("design", paper.DESIGNS)
def test_a_design_is_trained_by_both_algorithms_with_every_seed(design):
    scale = paper.scales("Goal-Hazard8-Point")["reduced_10m"]
    config = paper.table("Goal-Pillar-Point", [design], scale)
    cost = paper.DESIGNS[design]
    assert config.seeds == (0, 1, 2, 3, 4)
    assert {method.algorithm for method in config.methods} == set(cost.algorithms)
    assert {method.limit for method in config.methods} == {cost.limit}
    assert all((m.theta is None) == (not cost.found) for m in config.methods)
    assert config.train.env.physics == "reduced"


def test_the_scale_of_the_paper_is_its_preset():
    scale = paper.scales()["paper"]
    train = paper.table("Goal-Hazard-Point", ["extrinsic"], scale).train
    assert (train.num_worlds, train.num_epochs) == (30, 333)
    assert train.agent.hidden_sizes == (256, 256)
    assert train.agent.policy_minibatches == 1


def test_a_longer_scale_differs_in_epochs_alone():
    short, long = (paper.scales()[name] for name in ("reduced", "reduced_2m"))
    for world in ("Goal-Hazard-Point", "Goal-Hazard-Car"):
        configs = [paper.table(world, ["margin_2x"], scale) for scale in (short, long)]
        epochs = 4 * configs[0].train.num_epochs
        train = dataclasses.replace(configs[0].train, num_epochs=epochs)
        assert dataclasses.replace(configs[0], train=train) == configs[1]
    assert paper.world_size("Goal-Hazard-Point", short) == (8, 64, 200)
    assert paper.world_size("Goal-Hazard-Car", long) == (4, 256, 50)


def test_the_longest_reduced_scale_has_the_steps_of_the_paper():
    long, full = (paper.scales()[name] for name in ("reduced_10m", "paper"))
    trains = [
        paper.table("Goal-Hazard-Point", ["extrinsic"], s).train for s in (long, full)
    ]
    assert paper.steps_a_slot(trains[0]) == paper.steps_a_slot(trains[1]) == 9_990_000
    assert trains[0].num_worlds == trains[1].num_worlds == 30
    agent = trains[0].agent  # what all results at reduced scale were trained with
    assert (agent.hidden_sizes, agent.normalize_obs) == ((64, 64), False)
    assert (agent.policy_passes, agent.policy_minibatches) == (6, 8)
    assert (agent.value_passes, agent.value_minibatches) == (6, 8)
    paper_agent = dataclasses.replace(
        trains[1].agent,
        hidden_sizes=(64, 64),
        policy_passes=6,
        policy_minibatches=8,
        value_passes=6,
        value_minibatches=8,
    )
    assert agent == paper_agent


def test_designs_are_those_whose_costs_were_found_in_the_world():
    """Without those that are another one at the same scale."""
    designs = ["extrinsic", "steep", "evolved", "evolved_dense", "evolved_reduced"]
    crowded = paper.scales("Goal-Hazard8-Point")
    assert paper.distinct(designs, paper.scales()["reduced"]) == ["extrinsic"]
    assert paper.distinct(designs, crowded["reduced"]) == designs[:3]
    assert paper.distinct(designs, crowded["reduced_10m"]) == designs
    same = crowded["reduced"]._replace(
        found=dict.fromkeys(("evolved", "brief"), "lidar_mlp_8")
    )
    assert paper.distinct(["evolved", "evolved_reduced"], same) == ["evolved"]


def test_the_crowded_world_has_eight_hazards_and_is_otherwise_the_same():
    for robot in ("Point", "Car"):
        name = f"Goal-Hazard-{robot}"
        assert paper.in_world(name, "Goal-Hazard-Point") == name
        crowded = paper.in_world(name, "Goal-Hazard8-Point")
        assert crowded == f"Goal-Hazard8-{robot}"
        plain, full = (
            paper.table(world, ["extrinsic"], paper.scales(training)["reduced"])
            for world, training in ((name, paper.WORLD), (crowded, paper.CROWDED))
        )
        env = dataclasses.replace(full.train.env, hazards_num=4)
        train = dataclasses.replace(full.train, env=env)
        assert full.train.env.hazards_num == 8
        assert dataclasses.replace(full, train=train) == plain
    for name in ("Push-Hazard-Point", "Goal-Pillar-Point"):
        assert paper.in_world(name, "Goal-Hazard8-Point") == name


@pytest.mark.parametrize("world", ["Goal-Hazard-Point", "Goal-Hazard8-Point"])
def test_each_world_has_folders_of_its_own(world, monkeypatch):
    words = ["x.py", "collect", "--scale", "reduced_10m", "--world", world]
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(paper, "use_machine", lambda: None)
    args = paper.arguments(paper.parser(None))
    folder = "eight_hazards" if "8" in world else world
    assert args.results.parts[-2:] == args.runs.parts[-2:] == (folder, "reduced_10m")


def test_what_was_measured_with_eight_hazards_says_so():
    files = [*CROWDED.rglob("*.json"), *CROWDED.rglob("*.md")]
    assert len(files) > 20
    for file in files:
        assert "Goal-Hazard-" not in file.read_text(), file


def test_tables_are_those_of_the_results_beside_them():
    others = {"shapes": shapes.render, "transfer": transfer.render}
    files = (ROOT / "experiments" / "results").glob("*/*/*.json")
    known = [file for file in files if file.stem in (*FIGURES, *others)]
    assert {file.stem for file in known} == {*FIGURES, *others}
    for file in known:
        expect = others.get(file.stem, paper.render)(json.loads(file.read_text()))
        assert file.with_suffix(".md").read_text() == expect, file


def test_files_that_the_page_of_the_experiments_shows_exist():
    page = ROOT / "experiments" / "README.md"
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text())
    assert len(links) > 10
    for link in links:
        assert (page.parent / link).exists(), link


def test_computing_times_are_steps_over_rate_and_updates(tmp_path):
    facts = {"device": "cpu"}
    names = (*computing_time.PAPER_HOURS, computing_time.CLOSED_FORM)
    steps = [
        {"name": name, "worlds": 1024, "env_steps_per_second": 1000}
        | {"facts": facts, "devices": 2, "command": "a"}
        for name in names
    ]
    updates = [
        {"algorithm": algorithm, "tera_flop_per_second": 0.1}
        for algorithm in ("ppo_lagrangian", "cpo")
    ]
    update = {"facts": facts, "devices": 2, "command": "b", "rows": updates}
    (tmp_path / "env_steps.json").write_text(json.dumps({"rows": steps}))
    (tmp_path / "population_paper.json").write_text(
        json.dumps({"parts": {"update": update}})
    )
    result = computing_time.collect(tmp_path)
    hours = result["hours"]["Goal-Hazard-Point"]
    assert hours["rollout"] == pytest.approx(333 * 30_000 / 1000 / 3600)
    # 3.1 TFLOP an epoch, as the design counts them
    update_hours = hours["ppo_lagrangian"] - hours["rollout"]
    assert update_hours == pytest.approx(333 * 31 / 3600, rel=0.05)
    agents = 50 * 7 * (hours["ppo_lagrangian"] + hours["cpo"])
    assert result["evolution_hours"] == pytest.approx(agents)
    assert result["hours"]["Goal-Hazard-Doggo"]["cpo"] > hours["cpo"]  # more readings
    assert result["gpu"] is None
    closed = {"facts": {"device": "H"}, "command": "c", "search_hours": 4.8}
    (tmp_path / "gpu").mkdir()
    file = tmp_path / "gpu" / "population_paper.json"
    file.write_text(json.dumps({"parts": {"closed_form": closed}}))
    table = computing_time.render(computing_time.collect(tmp_path))
    assert "| the same on an H | 54.1 | 4.8 for both | | |" in table
    steps[0]["facts"] = {"device": "gpu"}
    (tmp_path / "env_steps.json").write_text(json.dumps({"rows": steps}))
    with pytest.raises(SystemExit, match="different devices"):
        computing_time.collect(tmp_path)
    file.write_text(json.dumps({"parts": {"update": closed}}))
    assert computing_time.on_a_gpu(file) is None


def test_the_table_of_computing_times_is_that_of_the_benchmarks():
    result = computing_time.collect(ROOT / "benchmarks" / "results")
    file = ROOT / "experiments" / "results" / "computing_time.json"
    assert json.loads(file.read_text()) == json.loads(json.dumps(result))
    assert file.with_suffix(".md").read_text() == computing_time.render(result)


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
    ("rate", "layouts", "bound"),
    [(0.0, 1000, 0.002991), (0.0, 30, 0.0950), (0.1, 10, 0.3942), (1.0, 10, 1.0)],
)
def test_the_bound_of_a_rate(rate, layouts, bound):
    """Zero in N is about 3 / N; 1 of 10 is 0.394 in tables of the exact bound."""
    assert paper.upper_bound(rate, layouts) == pytest.approx(bound, abs=1e-4)


def test_seeds_that_play_the_same_layouts_do_not_tighten_the_bound():
    one, three = (paper.summarise([row(1.0, 0.1, 4)] * count) for count in (1, 3))
    assert three["violation_rate_upper"] == one["violation_rate_upper"]


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


@pytest.mark.parametrize(
    ("world", "words"),
    [("Goal-Hazard-Car", "Car 4"), ("Goal-Hazard8-Point", "Point 8")],
)
def test_safety_gymnasium_is_told_how_many_hazards_there_are(tmp_path, world, words):
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\nshift\necho "[\\"$*\\"]"\n')
    python.chmod(0o755)
    told = transfer.play(python, tmp_path / "policy.npz", world, 10, 3)
    assert told == [f"{tmp_path}/policy.npz {words} 10 3"]


def test_a_run_of_another_cost_is_not_taken_for_this_one(tmp_path):
    scale = paper.scales()["smoke"]
    old = paper.table("Goal-Hazard-Point", ["extrinsic"], scale)
    RunDir.create(tmp_path / "run", old).close()
    common.check_same(old, tmp_path / "run")
    new = paper.table("Goal-Hazard-Point", ["limit_-1"], scale)
    with pytest.raises(
        SystemExit, match=r"has methods\[0\]\.label=.* wanted .*limit_-1"
    ):
        common.check_same(new, tmp_path / "run")


def test_a_design_is_found_in_whatever_table_it_was_trained(tmp_path):
    """By what was trained: not by its label, nor with another cost or size."""
    world = "Goal-Hazard8-Point"
    scale = paper.scales(world)["smoke"]
    config = paper.table(world, ["extrinsic", "steep", "unconstrained"], scale)
    old = dataclasses.replace(config.methods[0], label="as it was called before")
    config = dataclasses.replace(config, methods=(old, *config.methods[1:]))
    assert paper.find(tmp_path, world, "steep", scale) is None
    with RunDir.create(tmp_path / world / "joint", config) as run:
        assert paper.find(tmp_path, world, "steep", scale) is None  # not finished
        run.write_json("evaluation", {"episodes": 2, "rows": []})
    found = paper.find(tmp_path, world, "steep", scale)
    labels = {"ppo_lagrangian": "steep-ppo_lagrangian", "cpo": "steep-cpo"}
    assert found == paper.Trained(tmp_path / world / "joint", labels)
    assert paper.find(tmp_path, world, "extrinsic", scale).labels == {
        "ppo_lagrangian": "as it was called before",
        "cpo": "extrinsic-cpo",
    }
    assert paper.find(tmp_path, world, "unconstrained", scale) is not None
    assert paper.find(tmp_path, world, "limit_-1", scale) is None
    assert paper.find(tmp_path, world, "steep", paper.scales(world)["reduced"]) is None


def test_a_table_holds_networks_of_one_size():
    """Costs without a network go with the first."""
    scale = paper.scales("Goal-Hazard8-Point")["smoke"]
    scale = scale._replace(found={**scale.found, "evolved": "min_distance_8"})
    groups = paper.by_network(["evolved", "extrinsic", "steep", "margin_2x"], scale)
    assert groups == [["extrinsic", "margin_2x", "evolved"], ["steep"]]
    for group in groups:
        paper.table("Goal-Hazard-Point", group, scale)
    assert paper.by_network(["extrinsic"], scale) == [["extrinsic"]]
    assert paper.by_network([], scale) == []


def test_a_shape_costs_what_its_name_says():
    inputs = CostInputs(
        cost=jnp.array([0.1, 0.0, 0.0]),
        constraint_lidar=jnp.zeros((3, 8)),
        distance=jnp.array([0.2, 0.5, 0.7]),
        previous_distance=jnp.zeros(3),
        radius=jnp.full(3, 0.3),
    )
    expect = {
        shapes.Shape("hinge", 2.0): [0.1 + 0.4, 0.1, 0.0],
        shapes.Shape("hinge", 2.0, 0.1, constant=1e-3): [0.141, 0.011, 0.001],
        shapes.Shape("step", 2.0, 0.5): [0.6, 0.5, 0.0],
        shapes.Shape("bowl", 2.0): [0.1 + 0.16 / 0.6, 0.01 / 0.6, 0.0],
    }
    for shape, cost in expect.items():
        slot = shapes.slot(shape._replace(limit=2.0), seed=0)
        assert slot.cost.limit == 2.0
        total = total_cost(slot.cost, inputs, shapes.SHAPES)
        np.testing.assert_allclose(total, cost, rtol=1e-5)
    assert len(set(shapes.TRIED)) == len(shapes.TRIED) == 29


@pytest.mark.slow
def test_shapes_from_training_to_picture(tmp_path):
    """In two goes; what is trained is not trained again."""
    words = ["--smoke", "--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    file = tmp_path / "runs" / "shapes.jsonl"

    def start(part):
        command = [sys.executable, "experiments/shapes.py", part, *words]
        subprocess.run([*command, "--at-once", "1"], check=True, cwd=ROOT)

    start("run")
    first, second = file.read_text().splitlines()
    file.write_text(second + "\n")
    start("run")
    assert file.read_text().splitlines()[0] == second
    again = json.loads(file.read_text().splitlines()[1])
    for algorithm in paper.BOTH:
        assert again[algorithm] == json.loads(first)[algorithm]
    start("collect")
    result = json.loads((tmp_path / "shapes.json").read_text())
    assert [row["shape"] for row in result["shapes"]] == [
        shape._asdict() for shape in shapes.TRIED[:2]
    ]
    assert result["episodes"] == 2 * 2 * 2
    for row in result["shapes"]:
        for algorithm in paper.BOTH:
            assert set(row[algorithm]) == set(shapes.SCORES)
            assert all(len(values) == 2 for values in row[algorithm].values())
    assert "| hinge 1.25x |" in (tmp_path / "shapes.md").read_text()
    assert (tmp_path / "shapes.png").exists()


def test_fresh_scores_stand_beside_the_shapes(tmp_path):
    file = CROWDED / "reduced_10m" / "margins.json"
    found = dict(shapes.fresh_scores(file, "Goal-Hazard8-Point", "cpo"))
    assert list(found) == list(shapes.MARKERS)
    assert found["margin_2x"]["episodes"] == 1000
    assert shapes.fresh_scores(file, "Goal-Hazard-Point", "cpo") == []
    assert shapes.fresh_scores(tmp_path / "none.json", "Goal-Hazard-Point", "cpo") == []


@pytest.mark.slow
def test_one_figure_from_training_to_picture(tmp_path):
    words = ["--smoke", "--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    for part in ("run", "run", "collect"):  # the second finds everything done
        subprocess.run(
            [sys.executable, "experiments/figures.py", part, "cost_limits", *words],
            check=True,
            cwd=ROOT,
        )
    trained = [
        path.name for path in (tmp_path / "runs" / "Goal-Hazard-Point").iterdir()
    ]
    assert trained == ["limit_0.5+extrinsic"]  # side by side
    result = json.loads((tmp_path / "cost_limits.json").read_text())
    assert result["world"] == "Goal-Hazard-Point"
    panel = result["worlds"]["Goal-Hazard-Point"]
    assert list(panel) == ["limit_0.5", "extrinsic"]
    for trained in panel.values():
        assert set(trained["algorithms"]) == {"ppo_lagrangian", "cpo"}
        for scores in trained["algorithms"].values():
            assert scores["episodes"] == 4
            assert len(scores["curves"]["ep_cost"]["mean"]) == 2
    assert "smoke scale" in (tmp_path / "cost_limits.md").read_text()
    assert (tmp_path / "cost_limits.png").stat().st_size > 10_000
