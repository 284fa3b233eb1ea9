"""The figures of the paper: what is trained, how it is counted, and one end to end."""

import argparse
import dataclasses
import json
import re
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax import cost_card, load_cost, preset
from autocost_jax.costs import total_cost
from autocost_jax.env_config import ENVS
from autocost_jax.methods import Method, TableConfig
from autocost_jax.records import CostInputs
from autocost_jax.store import RunDir
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
common = load_script("experiments/common")
computing_time = load_script("experiments/computing_time")
paper = load_script("experiments/paper")
searches = load_script("experiments/searches")
searches_tables = load_script("experiments/searches_tables")
shapes = load_script("experiments/shapes")
transfer = load_script("experiments/transfer")
PLAN = searches.PLANS["smoke"]


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
    config = paper.table("Goal-Pillar-Point", [design], scale)
    cost = paper.DESIGNS[design]
    assert config.seeds == (0, 1, 2, 3, 4)
    assert {method.algorithm for method in config.methods} == set(cost.algorithms)
    assert {method.limit for method in config.methods} == {cost.limit}
    assert all((m.theta is None) == (cost.theta is None) for m in config.methods)
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
        configs = [paper.table(world, ["steep"], scale) for scale in (short, long)]
        epochs = 4 * configs[0].train.num_epochs
        train = dataclasses.replace(configs[0].train, num_epochs=epochs)
        assert dataclasses.replace(configs[0], train=train) == configs[1]
    assert paper.world_size("Goal-Hazard-Point", short) == (8, 64, 200)
    assert paper.world_size("Goal-Hazard-Car", long) == (4, 256, 50)


def test_a_design_that_is_another_one_at_a_scale_is_left_out():
    designs = ["steep", "evolved", "evolved_reduced"]
    reduced, long = (paper.scales()[name] for name in ("reduced", "reduced_10m"))
    assert paper.distinct(designs, reduced) == ["steep", "evolved"]
    assert paper.distinct(designs, long) == designs


def test_the_longest_reduced_scale_has_the_steps_of_the_paper():
    long, full = (paper.scales()[name] for name in ("reduced_10m", "paper"))
    trains = [
        paper.table("Goal-Hazard-Point", ["extrinsic"], s).train for s in (long, full)
    ]
    assert paper.steps_a_slot(trains[0]) == paper.steps_a_slot(trains[1]) == 9_990_000
    assert trains[0].num_worlds == trains[1].num_worlds == 30
    assert trains[0].agent == preset("search").train.agent  # smaller


def test_the_tables_of_the_readme_are_those_of_the_results():
    text = (ROOT / "experiments" / "README.md").read_text()
    blocks = re.findall(
        r"<!-- (reduced\w*/\w+) -->\n(.*?)<!-- end -->", text, re.DOTALL
    )
    assert {name for name, _ in blocks} >= {"reduced/evolution", "reduced/margins"}
    for name, shown in blocks:
        file = ROOT / "experiments" / "results" / f"{name}.json"
        result = json.loads(file.read_text())
        render = {
            "evolution": searches_tables.render,
            "shapes": shapes.render,
            "transfer": transfer.render,
        }
        expect = render.get(file.stem, paper.render)(result)
        assert shown.strip() == expect.strip(), name


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
    text = (ROOT / "experiments" / "README.md").read_text()
    shown = re.search(r"<!-- computing_time -->\n(.*?)<!-- end -->", text, re.DOTALL)
    assert shown is not None
    assert shown[1].strip() == computing_time.render(result).strip()


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


def test_a_run_of_another_cost_is_not_taken_for_this_one(tmp_path):
    scale = paper.scales()["smoke"]
    old = paper.table("Goal-Hazard-Point", ["extrinsic"], scale)
    RunDir.create(tmp_path / "run", old).close()
    common.check_same(old, tmp_path / "run")
    new = paper.table("Goal-Hazard-Point", ["limit_-1"], scale)
    with pytest.raises(SystemExit, match=r"'limit': 0\.0.* wanted .*'limit': -1\.0"):
        common.check_same(new, tmp_path / "run")


def write_search(runs, costs, returns):
    """A finished search of two stages; candidate 1 of the first is trained again."""
    config = dataclasses.replace(preset("smoke"), seed=0)
    theta = np.arange(8 * 41, dtype=np.float32).reshape(2, 4, 41)
    theta[1, 0] = theta[0, 1]
    near = np.array([[0.0, 0.02, 0.03, 0.4], [0.004, 0.06, 0.05, 0.6]])  # [A, P]
    with RunDir.create(searches.folder(runs, "guided", 0), config) as run:
        for stage in range(2):
            run.write_stage(
                stage,
                {
                    "theta": theta[stage],
                    "cost": np.float32(costs[stage]),
                    "ep_return": np.float32(returns[stage]),
                    "scores/intrinsic_near": near,
                    "scores/ep_cost": np.tile(np.float32(costs[stage]), (2, 1)),
                    "scores/ep_return": np.tile(np.float32(returns[stage]), (2, 1)),
                },
            )
        run.write_cost({"theta": theta[0, 0]}, {"search_cost": 0.0})
    return theta


def write_round(runs, index, scores):
    """Scores of each entrant, (return, cost, violating of 100) by algorithm."""
    methods, rows = [], []
    for i, row_of in enumerate(searches.entrants(runs, PLAN, index)):
        theta = tuple(row_of["theta"].tolist())
        for algorithm, score in zip(paper.BOTH, scores[i], strict=True):
            label = f"{i}-{algorithm}"
            methods.append(Method(label, algorithm, paper.WITH_NETWORK, 0.0, theta))
            rows.append({"method": label, "seed": 100} | row(*score))
    config = TableConfig(preset("smoke").train, tuple(methods), (100,))
    with RunDir.create(runs / PLAN.rounds[index].name, config) as run:
        run.write_json("evaluation", {"episodes": 100, "rows": rows})


def test_the_shipped_cost_is_the_best_useful_one_of_the_last_round(tmp_path):
    """Timid candidates come last, one that was trained twice counts by its mean."""
    costs = [[0.0, 1.0, 0.5, 9.0], [3.0, 4.0, 5.0, 6.0]]
    returns = [[-3.0, 5.0, 1.0, 9.0], [7.0, 6.0, 5.0, 4.0]]
    runs = tmp_path / "runs"
    theta = write_search(runs, costs, returns)
    ranked = searches.candidates(runs, PLAN, PLAN.rounds[0])
    assert [row["index"] for row in ranked] == [1, 1, 2, 3, 3, 2, 0]
    assert (ranked[0]["cost"], ranked[0]["times_trained"]) == (2.0, 2)
    worse = [[(9.0, 4.0 + i, 60)] * 2 for i in range(5)]
    write_round(runs, 0, [worse[0], *[[(3.0, 2.0, 50)] * 2] * 2, *worse[1:]])
    found = searches.entrants(runs, PLAN, 1)
    assert [row["index"] for row in found] == [1, 2, 1, 3]
    timid, best = [(1.0, 0.0, 0)] * 2, [(4.0, 0.1, 3), (3.0, 0.0, 0)]
    write_round(runs, 1, [timid, best, *worse[:2]])
    args = argparse.Namespace(runs=runs, results=tmp_path, smoke=True, scale="smoke")
    searches.ship(args)
    shipped = load_cost(tmp_path / "costs" / "ic4srl_reduced")
    np.testing.assert_array_equal(shipped, found[1]["theta"])
    np.testing.assert_array_equal(found[1]["theta"], theta[1, 2])
    card = cost_card(tmp_path / "costs" / "ic4srl_reduced")
    assert card["fails"] == "not free of violations under PPO-Lag"
    assert card["validation"]["cpo"]["violation_rate_upper"] > 0
    others = (tmp_path / "costs").glob("ic4srl_reduced_runner_up_*.npz")
    assert len(list(others)) == 3
    searches.collect(args)
    table = (tmp_path / "evolution.md").read_text()
    assert "| guided, 0 | 2.62, 4.50 | 0.00, 3.00 |" in table
    assert "| 0.003 to 0.01 |" not in table
    assert "| 0.03 to 0.1 | 4 | 2.6 | 4.2 |" in table
    assert "| 0.3 to 1.0 | 2 | 7.5 | 6.5 |" in table
    assert "| shortlist |" in table
    assert "| validation |" in table
    assert (tmp_path / "heat_map_ic4srl_reduced.png").exists()
    assert (tmp_path / "evolution.png").exists()


def test_runners_up_follow_from_the_round_before(tmp_path):
    """One cost is validated; who came behind it is known from the shortlist."""
    runs = tmp_path / "runs"
    write_search(runs, [[1.0, 2.0, 3.0, 4.0]] * 2, [[5.0] * 4] * 2)
    first = PLAN.rounds[0]._replace(entrants=3)
    last = PLAN.rounds[1]._replace(entrants=1)
    plan = PLAN._replace(rounds=(first, last))
    scores = [[(5.0, cost, 9)] * 2 for cost in (0.3, 0.1, 0.2, 0.4, 0.5, 0.6, 0.7)]
    write_round(runs, 0, scores)
    order = [row["index"] for row in searches.scored(runs, plan, 0)]
    write_round(runs, 1, scores)
    rows = searches.placed(runs, plan, 1)
    assert [row["index"] for row, _ in rows] == order
    assert [part.name for _, part in rows] == ["validation", "shortlist", "shortlist"]


def test_rounds_wait_for_their_searches(tmp_path, capsys):
    args = argparse.Namespace(runs=tmp_path, smoke=True, scale="smoke")
    searches.validate(args)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(PLAN.rounds)
    assert lines[0] == "shortlist: no finished search by guided or paper or raw"
    assert not list(tmp_path.iterdir())


def test_the_worse_of_two_agents_can_decide(tmp_path):
    """The best by the mean has an agent that flees, another a costly one."""
    runs = tmp_path / "runs"
    costs = [[0.0, 1.0, 0.5, 9.0], [3.0, 4.0, 5.0, 6.0]]
    write_search(runs, costs, [[5.0, 5.0, 5.0, 9.0], [7.0, 6.0, 5.0, 4.0]])
    scores = [[(9.0, 0.9, 60), (-3.0, 0.0, 0)], [(4.0, 0.5, 9), (3.0, 0.6, 9)]]
    scores += [[(9.0, 1.0, 60), (9.0, 0.0, 60)]] + [[(9.0, 5.0, 60)] * 2] * 4
    write_round(runs, 0, scores)
    first = searches.entrants(runs, PLAN, 0)
    for judge, expect in (("mean", [0, 2, 1]), ("worst", [1, 2, 3])):
        plan = PLAN._replace(rounds=(PLAN.rounds[0]._replace(judge=judge),))
        ranked = searches.scored(runs, plan, 0)[:3]
        assert [row["theta"].tolist() for row in ranked] == [
            first[i]["theta"].tolist() for i in expect
        ]


def test_a_design_is_found_in_whatever_table_it_was_trained(tmp_path):
    """By what was trained: not by its label, nor with another cost or size."""
    scale, world = paper.scales()["smoke"], "Goal-Hazard-Point"
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
    assert paper.find(tmp_path, world, "steep", paper.scales()["reduced"]) is None


def test_a_round_of_the_searches_counts_as_trained(tmp_path):
    scale, world = paper.scales()["smoke"], "Goal-Hazard-Point"
    config = paper.table(world, ["evolved"], scale)
    with RunDir.create(tmp_path / "a_round", config) as run:
        run.write_json("evaluation", {"episodes": 2, "rows": []})
    found = paper.find(tmp_path, world, "evolved", scale)
    assert found is not None
    assert found.path == tmp_path / "a_round"
    assert paper.find(tmp_path, "Goal-Pillar-Point", "evolved", scale) is None


def test_a_table_holds_networks_of_one_size():
    """Costs without a network go with the first."""
    scale = paper.scales()["smoke"]._replace(evolved="ic4srl_nearest")
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
    file = ROOT / "experiments" / "results" / "reduced_10m" / "margins.json"
    found = dict(shapes.fresh_scores(file, "cpo"))
    assert list(found) == list(shapes.MARKERS)
    assert found["margin_2x"]["episodes"] == 1000
    assert shapes.fresh_scores(tmp_path / "none.json", "cpo") == []


def test_one_figure_from_training_to_picture(tmp_path):
    words = ["--smoke", "--runs", str(tmp_path / "runs"), "--results", str(tmp_path)]
    for part in ("run", "run", "collect"):  # the second finds everything done
        subprocess.run(
            [sys.executable, "experiments/cost_limits.py", part, *words],
            check=True,
            cwd=ROOT,
        )
    trained = [
        path.name for path in (tmp_path / "runs" / "Goal-Hazard-Point").iterdir()
    ]
    assert trained == ["limit_0.5+extrinsic"]  # side by side
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
