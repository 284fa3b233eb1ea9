"""The main job, measured: does the search find costs that make agents safe?

    python experiments/main_job.py search     # 3 seeds, paper's and random selection
    python experiments/main_job.py baseline   # extrinsic cost only, the same budget
    python experiments/main_job.py wide       # one larger search, PPO-Lagrangian only
    python experiments/main_job.py long       # the found costs, trained for longer
    python experiments/main_job.py collect    # JSON and figures from the runs above

Each part can be stopped and started again; finished runs are kept. Results are
written to experiments/results/laptop/, reduced scale: nothing here is the paper's.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from autocost_jax import intrinsic_cost, load_cost, make_env, preset
from autocost_jax.arrays import load_arrays
from autocost_jax.commandline import use_devices
from autocost_jax.config import THETA_SIZES
from autocost_jax.methods import Method, TableConfig, run_table
from autocost_jax.rundata import to_json
from autocost_jax.store import list_stages, read_config, read_metrics, run_facts

RUNS = Path("runs/main_job")
RESULTS = Path("experiments/results/laptop")
SEEDS = (0, 1, 2)
SELECTIONS = ("paper", "random")
LONG_SEEDS = (0, 1)
LONG_EPOCHS = 300
WIDE = ("--algorithms", "ppo_lagrangian", "--population-size", "16")
WIDE += ("--num-elites", "4", "--num-epochs", "36", "--num-stages", "6")
STEEP_HEIGHT, STEEP_MARGIN, STEEP_WIDTH = 0.1, 0.1, 0.03
TIMID_DISTANCE = 1.0  # metres an episode


def search_dir(selection: str, seed: int) -> Path:
    """Where one search lives."""
    return RUNS / f"search_{selection}_{seed}"


def search_command(out: Path, *flags: str) -> None:
    """Run or resume `python -m autocost_jax.evolve` unless it is done."""
    if is_finished(out, "report/index.html"):
        return
    command = [sys.executable, "-m", "autocost_jax.evolve", "--out", str(out)]
    started = (out / "config.yaml").exists()
    subprocess.run([*command, *(["--resume"] if started else flags)], check=True)


def is_finished(path: Path, file: str) -> bool:
    """Whether a run has written its last file."""
    return (path / file).exists()


def run_searches() -> None:
    """The laptop preset as a user runs it, for each seed and selection."""
    for seed in SEEDS:
        for selection in SELECTIONS:
            flags = ("--seed", str(seed), "--selection", selection)
            search_command(search_dir(selection, seed), *flags)


def run_wide() -> None:
    """More candidates and stages, longer training, one algorithm."""
    search_command(RUNS / "wide", *WIDE)


def run_baseline() -> None:
    """PPO-Lagrangian and CPO on the extrinsic cost alone, one stage's budget."""
    devices = use_devices(None)
    config = TableConfig(
        train=preset("laptop").train,
        methods=(
            Method("ppo_lagrangian", "ppo_lagrangian"),
            Method("cpo", "cpo"),
        ),
        seeds=tuple(range(8)),
    )
    run_if_needed(config, RUNS / "baseline", devices)


def run_long() -> None:
    """Extrinsic only, the best searched costs and a steep one, for longer."""
    devices = use_devices(None)
    train = dataclasses.replace(
        preset("laptop").train, num_epochs=LONG_EPOCHS, chunk_epochs=1
    )
    best = min(SEEDS, key=lambda seed: rank_key(search_dir("paper", seed)))
    costs = {
        "searched_laptop": found_cost(search_dir("paper", best)),
        "searched_wide": found_cost(RUNS / "wide"),
    }
    costs["steep"] = tuple(fit_steep().tolist())
    methods = []
    for algorithm in ("ppo_lagrangian", "cpo"):
        methods.append(Method(f"{algorithm}_extrinsic", algorithm))
        for name, theta in costs.items():
            cost = "extrinsic+intrinsic"
            methods.append(Method(f"{algorithm}_{name}", algorithm, cost, 0.0, theta))
    config = TableConfig(train=train, methods=tuple(methods), seeds=LONG_SEEDS)
    run_if_needed(config, RUNS / "long", devices)


def run_if_needed(config: TableConfig, path: Path, devices: Sequence[Any]) -> None:
    """Train a table unless that is done; continue where it was stopped."""
    if is_finished(path, "evaluation.json"):
        return
    resume = (path / "config.yaml").exists()
    run_table(config, path, resume=resume, devices=devices, num_episodes=200)


def found_cost(path: Path) -> tuple[float, ...]:
    """The best cost of a search, by the paper's rule."""
    return tuple(load_cost(path / "cost.npz").tolist())


def rank_key(path: Path) -> tuple[float, float]:
    """The paper's order of searches: cost, then return."""
    card = json.loads((path / "cost.json").read_text())
    return card["search_cost"], -card["search_return"]


def fit_steep(num_layouts: int = 2048, steps: int = 4000) -> jax.Array:
    """A hand-set cost: the network fitted to a steep wall around the hazards.

    The target is height * sigmoid((R + margin - D) / width) at random robot places of
    random layouts; only its shape is hand-made, the 41 parameters are regressed.
    """
    env = make_env("Goal-Hazard-Point")
    starts = jax.random.split(jax.random.key(7), num_layouts)
    state = jax.jit(jax.vmap(env.reset))(starts)
    keys = jax.random.split(jax.random.key(8), num_layouts)
    place = jax.random.uniform(jax.random.key(9), (num_layouts, 2), minval=-2, maxval=2)
    layout = state.layout.replace(robot_xy=place)
    inputs = jax.jit(jax.vmap(env.reset_to))(layout, keys).cost_inputs
    edge = inputs.radius + STEEP_MARGIN
    target = STEEP_HEIGHT * jax.nn.sigmoid((edge - inputs.distance) / STEEP_WIDTH)
    optimiser = optax.adam(0.02)

    def loss(theta: jax.Array) -> jax.Array:
        cost = intrinsic_cost(theta, inputs.constraint_lidar)
        return jnp.mean((cost - target) ** 2) / STEEP_HEIGHT**2

    def body(carry, _):
        theta, moments = carry
        value, gradient = jax.value_and_grad(loss)(theta)
        change, moments = optimiser.update(gradient, moments)
        return (theta + change, moments), value

    start = jax.random.normal(jax.random.key(10), (16, THETA_SIZES["dense"]))

    def fit(theta: jax.Array):
        state = (theta, optimiser.init(theta))
        (theta, _), values = jax.lax.scan(body, state, None, steps)
        return theta, values[-1]

    thetas, losses = jax.jit(jax.vmap(fit))(start)
    return thetas[jnp.argmin(losses)]


def bootstrap_fall(first: np.ndarray, last: np.ndarray) -> list[float]:
    """95 % interval of mean(first) - mean(last), candidates resampled."""
    rng = np.random.default_rng(0)
    draws = [
        rng.choice(first, first.size).mean() - rng.choice(last, last.size).mean()
        for _ in range(20_000)
    ]
    return [float(x) for x in np.percentile(draws, [2.5, 97.5])]


def count_useful(stage: dict[str, np.ndarray]) -> int:
    """Candidates quiet far from hazards and loud near them, over visited states."""
    far = stage["scores/intrinsic_far"].mean(0)
    near = stage["scores/intrinsic_near"].mean(0)
    return int(((far < 0.01) & (near > 0.1)).sum())


def collect_search(path: Path) -> dict[str, Any]:
    """Stage means and the fall of one search."""
    config, _ = read_config(path)
    stages = [load_arrays(file) for file in list_stages(path).values()]
    rates = [row["time/env_steps_per_second"] for row in read_metrics(path)]
    travelled = [stage["scores/distance_travelled"] for stage in stages]
    return {
        "seed": config.seed,
        "selection": config.selection,
        "cost": [stage["cost"].tolist() for stage in stages],
        "stage_mean_cost": [float(stage["cost"].mean()) for stage in stages],
        "stage_mean_return": [float(stage["ep_return"].mean()) for stage in stages],
        "stage_zero": [int((stage["cost"] <= 0).sum()) for stage in stages],
        "quiet_far_loud_near": sum(count_useful(stage) for stage in stages),
        "timid_share": [float((x < TIMID_DISTANCE).mean()) for x in travelled],
        "fall": float(stages[0]["cost"].mean() - stages[-1]["cost"].mean()),
        "fall_95": bootstrap_fall(stages[0]["cost"], stages[-1]["cost"]),
        "env_steps_per_second": rates[-1],
        "best": json.loads((path / "cost.json").read_text()),
    }


def selection_effect(searches: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Last stage, random selection minus the paper's: both met the same layouts."""
    last = {
        search["selection"]: search for search in searches if search["seed"] == seed
    }
    paper, control = (np.asarray(last[name]["cost"][-1]) for name in SELECTIONS)
    return {
        "seed": seed,
        "cost": float(control.mean() - paper.mean()),
        "cost_95": bootstrap_fall(control, paper),
        "return": last["random"]["stage_mean_return"][-1]
        - last["paper"]["stage_mean_return"][-1],
    }


def collect() -> None:
    """Write the JSON and the figures of whatever has been run."""
    use_devices(None)  # so that the facts name the devices that the runs had
    RESULTS.mkdir(parents=True, exist_ok=True)
    searches = [
        collect_search(search_dir(selection, seed))
        for selection in SELECTIONS
        for seed in SEEDS
        if is_finished(search_dir(selection, seed), "cost.json")
    ]
    result: dict[str, Any] = {
        "commands": [f"python experiments/main_job.py {p}" for p in PARTS],
        "facts": run_facts(),
        "preset": "laptop (reduced scale, not the paper's)",
        "searches": searches,
    }
    if is_finished(RUNS / "wide", "cost.json"):
        result["wide"] = collect_search(RUNS / "wide") | {"flags": " ".join(WIDE)}
    both = [
        seed
        for seed in SEEDS
        if len([search for search in searches if search["seed"] == seed]) == 2
    ]
    result["selection_effect"] = [selection_effect(searches, seed) for seed in both]
    for name in ("baseline", "long"):
        if is_finished(RUNS / name, "evaluation.json"):
            text = (RUNS / name / "evaluation.json").read_text()
            result[name] = json.loads(text)["rows"]
            config, _ = read_config(RUNS / name, TableConfig)
            result[f"{name}_epochs"] = config.train.num_epochs
    text = json.dumps(to_json(result), indent=1, allow_nan=False)
    (RESULTS / "main_job.json").write_text(text + "\n")
    (RESULTS / "main_job.md").write_text(render(result))
    draw_searches(result)
    if "long" in result:
        draw_long(result["long"])
    print(RESULTS / "main_job.json")


def render(result: dict[str, Any]) -> str:
    """The tables of the README, from the JSON."""

    def numbers(values: list[float], digits: int = 1) -> str:
        return ", ".join(f"{value:.{digits}f}" for value in values)

    lines = [
        "| search | selection | cost, mean of each stage | fall (95 %) "
        "| return, mean of each stage | share under 1 m | at zero |",
        "|---|---|---|---|---|---|---|",
    ]
    named = [
        (f"laptop, seed {search['seed']}", search) for search in result["searches"]
    ]
    named += [("wide, seed 0", result["wide"])] if "wide" in result else []
    for name, search in named:
        low, high = search["fall_95"]
        timid = numbers(search["timid_share"])
        zero = f"{sum(search['stage_zero'])} of {sum(map(len, search['cost']))}"
        lines.append(
            f"| {name} | {search['selection']} | {numbers(search['stage_mean_cost'])} "
            f"| {search['fall']:.1f} ({low:.1f} to {high:.1f}) "
            f"| {numbers(search['stage_mean_return'])} | {timid} | {zero} |"
        )
    lines += [
        "",
        "| last stage, random minus paper's selection | cost (95 %) | return |",
        "|---|---|---|",
    ]
    for row in result["selection_effect"]:
        low, high = row["cost_95"]
        lines.append(
            f"| seed {row['seed']} | {row['cost']:.1f} ({low:.1f} to {high:.1f}) "
            f"| {row['return']:.1f} |"
        )
    for key in ("baseline", "long"):
        if key in result:
            title = f"trained for {result[f'{key}_epochs']} epochs"
            lines += ["", *method_table(title, result[key])]
    return "\n".join(lines) + "\n"


def method_table(title: str, rows: list[dict[str, Any]]) -> list[str]:
    """Means over seeds of one evaluated table of methods."""
    lines = [
        f"| {title} | seeds x episodes | return | extrinsic cost "
        "| violating episodes |",
        "|---|---|---|---|---|",
    ]
    for label in dict.fromkeys(row["method"] for row in rows):
        chosen = [row for row in rows if row["method"] == label]

        def spread(key: str, chosen: list[dict[str, Any]] = chosen) -> str:
            values = [row[key] for row in chosen]
            return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"

        rate = np.mean([row["violation_rate"] for row in chosen])
        lines.append(
            f"| {label.replace('_', ' ')} | {len(chosen)} x {chosen[0]['episodes']} "
            f"| {spread('return_mean')} | {spread('cost_mean')} | {rate:.0%} |"
        )
    return lines


def draw_searches(result: dict[str, Any]) -> None:
    """Stage means of cost and return, selection against random choice."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    cost, reward = figure.subplots(1, 2)
    for search in result["searches"]:
        is_paper = search["selection"] == "paper"
        style = {"color": "C0" if is_paper else "0.6", "marker": "o"}
        label = f"{search['selection']} selection" if search["seed"] == 0 else None
        stages = range(1, 1 + len(search["stage_mean_cost"]))
        cost.plot(stages, search["stage_mean_cost"], label=label, **style)
        reward.plot(stages, search["stage_mean_return"], label=label, **style)
    if "baseline" in result:
        level = np.mean([row["return_mean"] for row in result["baseline"]])
        reward.axhline(level, color="k", ls=":", label="extrinsic cost only")
        level = np.mean([row["cost_mean"] for row in result["baseline"]])
        cost.axhline(level, color="k", ls=":", label="extrinsic cost only")
    cost.set(xlabel="stage", ylabel="extrinsic cost an episode", ylim=(0, None))
    reward.set(xlabel="stage", ylabel="return an episode")
    for axes in (cost, reward):
        axes.set_xticks(range(1, 4))
        axes.legend(fontsize=8)
    figure.suptitle("laptop preset: mean over candidates, 3 search seeds", fontsize=10)
    figure.savefig(RESULTS / "searches.png", dpi=150)


def draw_long(rows: list[dict[str, Any]]) -> None:
    """Return against extrinsic cost of the longer runs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    labels = sorted({row["method"] for row in rows})
    for index, label in enumerate(labels):
        chosen = [row for row in rows if row["method"] == label]
        axes.errorbar(
            [row["cost_mean"] for row in chosen],
            [row["return_mean"] for row in chosen],
            xerr=[row["cost_ci"] for row in chosen],
            yerr=[row["return_ci"] for row in chosen],
            fmt="o" if label.startswith("ppo") else "s",
            color=f"C{index % (len(labels) // 2)}",
            label=label,
        )
    axes.set_xscale("symlog", linthresh=0.1)
    axes.set(xlabel="extrinsic cost an episode", ylabel="return an episode")
    axes.legend(fontsize=7)
    figure.savefig(RESULTS / "long.png", dpi=150)


PARTS = {
    "search": run_searches,
    "baseline": run_baseline,
    "wide": run_wide,
    "long": run_long,
    "collect": collect,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=PARTS)
    PARTS[parser.parse_args().part]()
