"""What the README and the documents say is so."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import autocost_jax
from autocost_jax import CostInputs, Fitness, env_config, preset, total_cost, train
from autocost_jax.cli import HELP
from autocost_jax.config import ENVS
from autocost_jax.envs.physics.models import scene_model
from autocost_jax.evolve.__main__ import main as evolve_main
from autocost_jax.runs.config_files import replace_fields
from autocost_jax.search.starts import LOUD_COSTS, QUIET_PLACES
from scripts import load_script
from toys import TRAIN, make_slot, make_toy_env

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
DOCS = {page.stem: page.read_text() for page in (ROOT / "docs").glob("*.md")}


def table_row(page: str, first_cell: str) -> str:
    (row,) = re.findall(rf"^\| {re.escape(first_cell)} \|(.*)\|$", DOCS[page], re.M)
    return row.strip()


def test_the_start_is_as_the_documents_say():
    row = table_row("search", "start of theta")
    low, high = QUIET_PLACES
    assert f"from {low:g} to {high:g}," in row
    low, high = LOUD_COSTS
    assert f"from {low:g} to {high:g} (log-uniform)" in row


def test_every_command_is_in_the_documents():
    commands = re.findall(r"^  (\w+) ", HELP, re.M)
    assert len(commands) == 9
    for command in commands:
        row = rf"^\| .*`autocost {command}\b"
        assert re.search(row, DOCS["commands"], re.M), command


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 150


def test_the_python_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(code.strip().splitlines()) <= 13
    # The same lines at a size that a test can afford.
    code = code.replace('preset("laptop")', 'preset("smoke")')
    exec(compile(code, "README.md", "exec"), {})
    first, second = capsys.readouterr().out.strip().splitlines()
    assert len(first.split()) == 2
    assert 0.0 <= float(second) <= 1.0


def test_what_the_documents_extend_works():
    """The page's functions, in a toy world and without a training."""
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", DOCS["extending"], re.S):
        exec(compile(code, "extending.md", "exec"), names)
    zeros = np.zeros(3)
    inputs = CostInputs(zeros, np.zeros((3, 8)), np.array([0.4, 0.6, 2]), zeros, zeros)  # pyright: ignore
    got = total_cost(names["cost"], inputs, names["bank"])
    np.testing.assert_allclose(got, [0.1, 0, 0], rtol=1e-6)

    env = make_toy_env()
    agent, slot = names["linear"](env), make_slot()
    _, metrics = jax.eval_shape(lambda slot: train(env, agent, slot, TRAIN), slot)
    assert metrics["gradient"].shape == (TRAIN.num_epochs,)

    config = preset("laptop")
    ep_return = jax.random.normal(jax.random.key(0), (config.population_size,))
    fitness = Fitness(-ep_return, ep_return)
    es, state = names["es"], names["es"].init()
    theta = es.ask(jax.random.key(0), state)
    told = es.tell(jax.random.key(0), state, theta, fitness)
    np.testing.assert_array_equal(told.elites[0], theta[ep_return.argmax()])


def test_the_page_of_the_interface_has_every_public_name():
    names = re.findall(r"^::: autocost_jax\.(\w+)$", DOCS["api"], re.M)
    assert sorted(names) == sorted(autocost_jax.__all__)


@pytest.mark.parametrize("name", ["laptop (default)", "search", "paper", "smoke"])
def test_the_preset_table_is_the_presets(name):
    key = f"`{name.split()[0]}`" + (" (default)" if "default" in name else "")
    row = table_row("commands", key)
    config = preset(name.split()[0])
    agent = config.train.agent
    words = [
        f"{config.population_size} candidates",
        f"{config.num_elites} elite",
        "nets " + "-".join(map(str, agent.hidden_sizes)),
        f"{config.train.num_worlds} worlds",
        f"{config.train.num_epochs} epochs",
        f"{config.num_stages} stages",
    ]
    if config.num_finalists:
        words.append(f"{config.num_finalists} finalists x {config.final_seeds} seeds")
    if name != "smoke":
        words.append(f"init_std {config.init_std:g}")
        words.append(
            "80 full-batch steps"
            if agent.policy_minibatches == 1
            else f"{agent.policy_passes} passes x {agent.policy_minibatches} mini"
        )
    for word in words:
        assert word in row, word


def test_the_table_of_the_worlds_is_that_of_the_configurations():
    goal, push = env_config("Goal-Hazard-Point"), env_config("Push-Hazard-Point")
    pillars, car = env_config("Goal-Pillar-Point"), env_config("Push-Hazard-Car")
    for config in ENVS.values():
        assert set(map(abs, config.placements_extents)) == {2.0}
        assert config.lidar_max_dist is None  # exponential
        assert config.num_steps == 1000
        assert not config.constrain_indicator
    assert table_row("worlds", "extents") == "2 m"
    crowded = env_config("Goal-Hazard8-Point")
    assert push.hazards_num == goal.hazards_num
    assert table_row("worlds", "hazards") == (
        f"{goal.hazards_num} (`Goal-Hazard8-*`: {crowded.hazards_num}), "
        f"radius {goal.hazards_size} m, keepout {goal.hazards_keepout} m"
    )
    assert table_row("worlds", "pillars") == (
        f"{pillars.pillars_num}, radius {pillars.pillars_size} m, "
        f"keepout {pillars.pillars_keepout} m"
    )
    assert table_row("worlds", "goal") == (
        f"radius {goal.goal_size} m, keepout {goal.goal_keepout} m"
    )
    assert table_row("worlds", "box") == (
        f"half-width {push.box_size} m, keepout {push.box_keepout} m "
        f"(Car: {car.box_size} m, {car.box_keepout} m)"
    )
    assert table_row("worlds", "robot keepout") == f"{goal.robot_keepout} m"
    assert table_row("worlds", "lidars") == (
        f"{goal.lidar_num_bins} bins, exponential, gain {goal.lidar_exp_gain:g}"
    )
    periods = []
    for robot in ("Point", "Car", "Doggo"):
        model = scene_model(env_config(f"Goal-Hazard-{robot}"))
        period = model.opt.timestep * goal.frameskip_binom_n
        periods.append(f"{period:g} s ({robot})")
    assert table_row("worlds", "episode") == f"1000 steps of {', '.join(periods)}"


def test_ci_runs_the_test_command_of_the_readme():
    (command,) = re.findall(r"^pip install -e '\.\[dev\]' && pytest$", README, re.M)
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    words = [line.split(" || ")[0].replace(" -q", "") for line in lines]
    first, second = map(words.index, command.split(" && "))
    assert first < second


def test_files_that_the_readme_shows_exist():
    for link in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        assert (ROOT / link).exists(), link


def test_the_wheel_would_hold_everything_that_is_read_at_run_time():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == [
        "src/autocost_jax"
    ]
    package = ROOT / "src" / "autocost_jax"
    xmls = [f"envs/physics/xmls/{robot}.xml" for robot in ("point", "car", "doggo")]
    for name in ("py.typed", "viz/page.html", *xmls):
        assert (package / name).exists()


@pytest.mark.parametrize(
    ("script", "result"),
    [
        ("benchmarks/env_steps", "benchmarks/results/env_steps"),
        ("benchmarks/population", "benchmarks/results/population_laptop"),
        ("benchmarks/population", "benchmarks/results/population_paper"),
        ("benchmarks/peers", "benchmarks/results/peers"),
        (
            "experiments/agreement",
            "experiments/results/eight_hazards/agreement/agreement",
        ),
    ],
)
def test_the_tables_are_those_of_the_committed_json(script, result):
    text = load_script(script).render(json.loads((ROOT / f"{result}.json").read_text()))
    assert len(text.splitlines()) > 2
    assert (ROOT / f"{result}.md").read_text().strip() == text.strip()
    assert any(f'--8<-- "{result}.md"' in page for page in DOCS.values())


def test_what_the_documents_include_exists():
    included = re.findall(r'^--8<-- "(.*)"$', "\n".join(DOCS.values()), re.M)
    assert len(included) >= 6
    for file in included:
        assert (ROOT / file).exists(), file


def test_the_speeds_of_the_readme_are_measured_ones():
    section = README.split("## How fast it is")[1].split("##")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    assert len(rows) > 4
    measured = (ROOT / "benchmarks" / "results" / "peers.md").read_text().splitlines()
    assert set(rows) <= set(measured)


def test_the_results_of_the_readme_are_those_of_the_main_job():
    file = ROOT / "experiments" / "results" / "main_job" / "main_job.json"
    result = json.loads(file.read_text())
    for seed, best in zip(result["seeds"], result["best"], strict=True):
        cells = [
            f"{row['return']:.1f} at {row['violation_rate']:.0%}"
            for row in best["rows"]
        ]
        assert f"| {seed} | {' | '.join(cells)} |" in README


def test_flags_and_settings_of_the_documents_exist(capsys):
    with pytest.raises(SystemExit):
        evolve_main(["--help"])
    text, pages = capsys.readouterr().out, " ".join(DOCS.values())
    flags = ["physics", "no-compile-cache", "num-finalists"]
    for flag in [*flags, "coordinator", "num-processes", "process-id"]:
        assert f"--{flag}" in pages
        assert f"--{flag}" in text
    names = re.findall(r"--set ([a-z_]+)=", pages) + re.findall(r"`(\w+): \w+`", pages)
    assert {"segments_per_episode", "population_chunk", "critic_precision"} <= set(
        names
    )
    assert {"start", "judge_by", "network"} <= set(names)
    options = {"seeds_per_candidate", "pool_scores", "references", "normalize_obs"}
    assert all(f"`{name}`" in pages for name in options)
    names += options
    for name in names:
        with pytest.raises(ValueError, match=f"{name} must be "):
            replace_fields(preset("laptop"), {name: object()})
