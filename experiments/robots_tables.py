"""Tables and figures of robots.py, from its JSON."""

from pathlib import Path
from typing import Any

import numpy as np

ALGORITHMS = ("ppo", "ppo_lagrangian", "cpo")
KINDS = ("Goal-Hazard", "Goal-Hazard8", "Goal-Pillar", "Push-Hazard", "Push-Pillar")
ROBOTS = ("Point", "Car", "Doggo")


def render(result: dict[str, Any]) -> str:
    """The tables of docs/training.md, from the JSON."""
    parts = [
        render_runs(result["runs"]) if result["runs"] else [],
        render_random(result["beats_random"]) if result["beats_random"] else [],
        render_limit(result["limit25"]) if result["limit25"] else [],
    ]
    return "\n\n".join("\n".join(part) for part in parts if part) + "\n"


def render_runs(runs: dict[str, Any]) -> list[str]:
    """Return and cost at the start and the end of each curve, and what broke."""
    lines = [
        "| world | steps an agent | PPO return, cost | PPO-Lagrangian | CPO "
        "| non-finite numbers |",
        "|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        cells = []
        for method in ALGORITHMS:
            slots = [slot for slot in run["slots"] if slot["method"] == method]
            ends = []
            for key in ("ep_return", "ep_cost"):
                curve = np.asarray([slot[key] for slot in slots]).mean(0)
                ends.append(f"{curve[:3].mean():.1f} to {curve[-3:].mean():.1f}")
            cells.append(", ".join(ends))
        bad = run["non_finite_numbers"] + run["failed_worlds"] + run["frozen_slots"]
        lines.append(
            f"| {name} | {run['steps_a_slot']:,} | {' | '.join(cells)} | {bad} |"
        )
    return lines


def interval(value: dict[str, float], digits: int = 1) -> str:
    """A mean and, in brackets, from where to where."""
    low, high = float(value["low"]), float(value["high"])
    return f"{value['mean']:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def render_random(runs: dict[str, Any]) -> list[str]:
    """Returns of PPO and of the random policies, and how sure the difference is."""
    lines = [
        "| world | steps a seed | PPO | untrained network | uniform actions "
        "| above untrained (95 %) | above uniform (95 %) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        returns = [f"{np.mean(values):.1f}" for values in run["returns"].values()]
        above = [interval(value) for value in run["difference"].values()]
        lines.append(
            f"| {name} | {run['steps_a_slot']:,} | {' | '.join([*returns, *above])} |"
        )
    return lines


def render_limit(tables: dict[str, Any]) -> list[str]:
    """Cost at the end of training and of fresh episodes, and CPO's own record."""
    lines = [
        "| steps in hazards per episode | limit | worlds x epochs, seeds "
        "| cost, last fifth of training | cost, fresh episodes "
        "| return, fresh episodes | mean KL | multiplier: first, peak, last |",
        "|---|---|---|---|---|---|---|---|",
    ]
    cases = ["| CPO case | 0 | 1 | 2 | 3 | 4 | all |", "|---" * 7 + "|"]
    for run in tables.values():
        size = f"{run['worlds']} x {run['epochs']}, {len(run['seeds'])}"
        for name, row in run["methods"].items():
            free = name == "ppo"
            multiplier = ", ".join(f"{x:.2f}" for x in row["multiplier"])
            lines.append(
                f"| {name.replace('_', ' ')} | {'none' if free else row['limit']} "
                f"| {size} | {interval(row['last_cost'])} "
                f"| {interval(row['fresh_cost'])} | {interval(row['fresh_return'])} "
                f"| {row['kl']:.4f} | {'none' if free else multiplier} |"
            )
        if "cpo" in run["methods"]:
            cpo, worlds = run["methods"]["cpo"], f"{run['worlds']} worlds"
            share = [f"{x:.1%}" for x in (*cpo["cases"], 1)]
            kept = [
                "none" if x is None else f"{x:.0%}"
                for x in (*cpo["accepted_in_case"], cpo["accepted"])
            ]
            cases.append(f"| {worlds}: share of updates | {' | '.join(share)} |")
            cases.append(f"| {worlds}: step accepted | {' | '.join(kept)} |")
    return [*lines, "", *cases]


def draw(result: dict[str, Any], folder: Path) -> None:
    """Every figure for which there is data."""
    for kind in KINDS:
        names = [f"{kind}-{robot}" for robot in ROBOTS]
        runs = {name: result["runs"][name] for name in names if name in result["runs"]}
        if runs:
            draw_runs(runs, folder / f"learning_{kind.lower().replace('-', '_')}.png")
    if result["beats_random"]:
        draw_random(result["beats_random"], folder / "random.png")
    if "limit25" in result["limit25"]:
        draw_limit(result["limit25"], folder / "limit25.png")


def band(axes: Any, run: dict[str, Any], key: str) -> None:
    """Mean over seeds of each method against the epoch, lowest to highest shaded."""
    for index, method in enumerate(ALGORITHMS):
        curves = [
            slot[key]
            for slot in run["slots"]
            if slot["method"] == method and key in slot
        ]
        if curves:
            values = np.asarray(curves, np.float64)
            epochs = np.arange(1, 1 + values.shape[1])
            label = method.replace("_", " ")
            axes.plot(epochs, values.mean(0), color=f"C{index}", label=label)
            axes.fill_between(
                epochs, values.min(0), values.max(0), color=f"C{index}", alpha=0.2
            )


def draw_runs(runs: dict[str, Any], file: Path) -> None:
    """Learning curves: a column a robot, return above cost."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3 * len(runs) + 1, 4.5), layout="constrained")
    axes = figure.subplots(2, len(runs), squeeze=False, sharex=True)
    for column, (name, run) in enumerate(runs.items()):
        band(axes[0, column], run, "ep_return")
        band(axes[1, column], run, "ep_cost")
        axes[0, column].set_title(f"{name}, {run['worlds']} worlds", fontsize=9)
        axes[1, column].set(xlabel="epoch", ylim=(0, None))
    axes[0, 0].set_ylabel("return per episode")
    axes[1, 0].set_ylabel("extrinsic cost per episode")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(file, dpi=150)


def draw_random(runs: dict[str, Any], file: Path) -> None:
    """Returns of each seed as bars and dots, and the differences with intervals."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    bars, differences = figure.subplots(1, 2)
    places = np.arange(len(runs))
    for index, name in enumerate(("ppo", "untrained", "uniform")):
        seeds = np.asarray([run["returns"][name] for run in runs.values()])
        x = places + 0.25 * (index - 1)
        bars.bar(x, seeds.mean(1), 0.22, color=f"C{index}", label=name, alpha=0.6)
        bars.plot(x, seeds, "k.", ms=4)
    for index, name in enumerate(("untrained", "uniform"), start=1):
        rows = [run["difference"][name] for run in runs.values()]
        mean = np.asarray([row["mean"] for row in rows], np.float64)
        low = np.asarray([row["low"] for row in rows], np.float64)
        differences.errorbar(
            mean,
            places + 0.2 * (index - 1.5),
            xerr=mean - low,
            fmt="o",
            color=f"C{index}",
            capsize=3,
            label=f"PPO minus {name}",
        )
    bars.set_xticks(places, [name.replace("-", "\n") for name in runs], fontsize=8)
    bars.set(ylabel="return of fresh episodes")
    differences.set_yticks(places, list(runs), fontsize=8)
    differences.axvline(0, color="k", lw=0.8)
    differences.set(xlabel="difference of return, 95 % t-interval over seeds")
    for axes in (bars, differences):
        axes.legend(fontsize=8)
    figure.savefig(file, dpi=150)


def draw_limit(tables: dict[str, Any], file: Path) -> None:
    """Above the cost of each table, below the return, multipliers and CPO's cases."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.5), layout="constrained")
    figure.suptitle(tables["limit25"]["env"], fontsize=9)
    axes = figure.subplots(2, 3)
    for cost, run in zip(axes[0], tables.values(), strict=False):
        band(cost, run, "ep_cost")
        limit = max(row["limit"] for row in run["methods"].values())
        cost.axhline(limit, color="k", ls="--", lw=1, label="limit")
        cost.set(ylabel="steps in hazards per episode", ylim=(0, None))
        cost.set_title(f"{run['worlds']} worlds, {len(run['seeds'])} seeds", fontsize=9)
        cost.legend(fontsize=8)
    run = tables["limit25"]
    band(axes[1, 0], run, "ep_return")
    axes[1, 0].set(ylabel="return per episode, first table")
    for table in tables.values():
        slots = [slot for slot in table["slots"] if slot["method"] == ALGORITHMS[1]]
        band(axes[1, 1], {"slots": slots}, "multiplier")
    axes[1, 1].set(ylabel="multiplier of PPO-Lagrangian", ylim=(0, None))
    chosen = [slot["case"] for slot in run["slots"] if slot["method"] == "cpo"]
    case = np.asarray(chosen, np.int32)
    epochs = np.arange(1, 1 + case.shape[1])
    for row, values in enumerate(case):
        axes[1, 2].plot(epochs, values + 0.12 * (row - 1), "|", color="C2", alpha=0.7)
    axes[1, 2].set(ylabel="case of CPO, first table", yticks=range(5), ylim=(-0.5, 4.5))
    for panel in axes.flat:
        panel.set_xlabel("epoch")
    figure.savefig(file, dpi=150)
