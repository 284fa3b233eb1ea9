"""The table and the picture of the searches, from the JSON that `searches.py` wrote."""

from pathlib import Path
from typing import Any

import numpy as np
import paper


def render(result: dict[str, Any]) -> str:
    """Searches, fitness by loudness, the winner by distance, rounds of fresh seeds."""

    def means(table: list[list[float]], digits: int) -> str:
        return ", ".join(f"{np.mean(row):.{digits}f}" for row in table)

    lines = [
        "| rule, seed | mean cost of each stage | best cost of each stage "
        "| mean return of each stage | at zero, of each stage "
        f"| both agents return {result['floor']:g} | lowest worse cost of these |",
        "|---|---|---|---|---|---|---|",
    ]
    for search in result["searches"]:
        best = ", ".join(f"{min(stage):.2f}" for stage in search["cost"])
        zero = ", ".join(str(sum(c <= 0 for c in stage)) for stage in search["cost"])
        worse = zip(search["worst_cost"], search["worst_return"], strict=True)
        useful = [
            [c for c, gain in zip(*stage, strict=True) if gain >= result["floor"]]
            for stage in worse
        ]
        lines.append(
            f"| {search['rule']}, {search['seed']} "
            f"| {means(search['cost'], 2)} | {best} "
            f"| {means(search['return'], 1)} | {zero} "
            f"| {', '.join(str(len(costs)) for costs in useful)} "
            f"| {', '.join(f'{min(c):.2f}' if c else '-' for c in useful)} |"
        )
    for rules, rows in result["loudness"].items():
        near = f"{rules}: cost of a step near a hazard"
        lines += heads(near, "trained", "mean cost", "mean return")
        for row in rows:
            lines.append(
                f"| {row['low']} to {row['high']} | {row['count']} | {row['cost']:.1f} "
                f"| {row['return']:.1f} |"
            )
    for name, rows in result["distance"].items():
        step = f"{name}: cost of a step"
        lines += heads("distance to the closest hazard", step, "10 % to 90 %")
        for row in rows:
            lines.append(
                f"| {row['low']:g} to {row['high']:g} m | {row['mean']:.4f} "
                f"| {row['p10']:.4f} to {row['p90']:.4f} |"
            )
    for name in result["rounds"]:
        lines += ["", *render_round(name.replace("_", " "), name, result[name])]
    return "\n".join(lines) + "\n"


def heads(*columns: str) -> list[str]:
    """The first lines of a table, after an empty one."""
    return ["", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]


def render_round(title: str, name: str, rows: list[dict[str, Any]]) -> list[str]:
    """The entrants of a round, best first."""
    columns = ("return (95 %)", "cost (95 %)", "violating (at most)")
    heads = [f"{paper.NAMES[a]}: {c}" for a in paper.BOTH for c in columns]
    lines = [
        f"| {title} | search: cost, return | {' | '.join(heads)} |",
        "|---" * (2 + len(heads)) + "|",
    ]
    for row in rows:
        cells = [
            f"{row['rule']} {row['seed']}, stage {row['stage'] + 1}, {row['index']}",
            f"{row['cost']:.2f}, {row['ep_return']:.1f}",
        ]
        for score in row[name].values():
            gain, cost = score["return"], score["cost"]
            cells += [
                f"{gain['mean']:.1f} ({gain['low']:.1f} to {gain['high']:.1f})",
                f"{cost['mean']:.2f} ({cost['low']:.2f} to {cost['high']:.2f})",
                f"{score['violation_rate']:.1%} ({score['violation_rate_upper']:.1%})",
            ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def draw(result: dict[str, Any], file: Path) -> None:
    """The paper's scatter: a dot a candidate, best and mean of each stage; by rule."""
    from matplotlib.figure import Figure

    rules = list(dict.fromkeys(search["rule"] for search in result["searches"]))
    if not rules:
        return
    size = (1 + 3.8 * max(2, len(rules)), 5.5)
    picture = Figure(figsize=size, layout="constrained")
    axes = picture.subplots(2, len(rules), sharey="row", sharex=True, squeeze=False)
    for column, rule in enumerate(rules):
        own = [search for search in result["searches"] if search["rule"] == rule]
        for search in own:
            color = f"C{search['seed']}"
            for row, key, best in ((0, "cost", min), (1, "return", max)):
                panel, table = axes[row, column], search[key]
                stages = np.arange(1, 1 + len(table))
                for stage, values in zip(stages, table, strict=True):
                    x = np.full(len(values), stage + 0.1 * (search["seed"] - 1))
                    panel.plot(x, values, "o", color=color, mfc="white", ms=3)
                label = f"seed {search['seed']}, mean"
                means = [np.mean(v) for v in table]
                panel.plot(stages, means, color=color, label=label)
                panel.plot(stages, [best(v) for v in table], ":", color=color)
        axes[0, column].set_title(f"{rule} rule (dotted: best)", fontsize=9)
        axes[0, column].set_yscale("symlog", linthresh=0.1)
        axes[0, column].axhline(0, color="r", linewidth=0.8)
        axes[1, column].set_xlabel("stage")
    num_stages = max(len(search["cost"]) for search in result["searches"])
    axes[1, 0].set_xticks(range(1, 1 + num_stages))
    axes[0, 0].set_ylabel("extrinsic cost an episode")
    axes[1, 0].set_ylabel("return an episode")
    axes[0, 0].legend(fontsize=6)
    title = f"Evolution, {result['scale']} scale: {result['size']}"
    picture.suptitle(title, fontsize=9)
    picture.savefig(file, dpi=130)
