"""Return against violations: every agent of a search, one panel for each algorithm."""

from typing import TYPE_CHECKING

import numpy as np

from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.viz.cost_map import Array
from autocost_jax.viz.figures import (
    BEST,
    INK,
    MUTED,
    PAPER,
    Draw,
    draw_row,
    label_axes,
    legend,
)
from autocost_jax.viz.report_data import ReportData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = {"extrinsic": "s", "safety_margin_3x": "^"}
LEAST_SPAN = 10.0  # percent; narrower, an axis would make much of a single episode


def tradeoff_figure(data: ReportData) -> "Figure":
    """Return against share of violating episodes, one panel for each algorithm."""
    return draw_row([draw for _, draw in tradeoff_panels(data)])


def tradeoff_panels(data: ReportData) -> list[tuple[str, Draw]]:
    """(algorithm, drawing) of each panel; empty without known violations."""
    if not data.can_violate or not any(
        np.isfinite(stage.mean_violation_rate) for stage in data.stages
    ):
        return []

    def panel(row: int, name: str) -> tuple[str, Draw]:
        return name, lambda axes: _draw(axes, data, row)

    return [panel(row, name) for row, name in enumerate(data.algorithms)]


def candidates(data: ReportData, row: int) -> tuple[Array, Array, Array]:
    """One algorithm's agents of all stages whose numbers are known.

    Args:
      data: the report's data.
      row: index of the algorithm.

    Returns:
      [N] share of violating episodes, [N] return, [N] stage from 0.
    """
    parts = [np.zeros((3, 0))]
    for number, stage in enumerate(data.stages):
        if stage.violation_rate is not None:
            rate, ep_return = stage.violation_rate[row], stage.algorithm_return[row]
            known = stage.finite & np.isfinite(rate) & np.isfinite(ep_return)
            at = np.full(known.sum(), number)
            parts.append(np.stack([rate[known], ep_return[known], at]))
    rate, ep_return, at = np.concatenate(parts, 1)
    return rate, ep_return, at.astype(int)


def front(rate: Array, ep_return: Array) -> Array:
    """Indices of the agents that no other beats in both, by rising violations.

    Args:
      rate: [N] share of violating episodes; lower is better.
      ep_return: [N] return; higher is better.
    """
    kept, highest = [], -np.inf
    for i in np.lexsort((-ep_return, rate)):
        if ep_return[i] > highest:
            kept.append(int(i))
            highest = ep_return[i]
    return np.array(kept, int)


def _draw(axes: "Axes", data: ReportData, row: int) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm, ListedColormap

    rate, ep_return, stage = candidates(data, row)
    rate, count = 100 * rate, len(data.stages)
    # The ends of the map would vanish on a white or a black page.
    shades = colormaps["viridis"](np.linspace(0.15, 0.92, max(count, 2))[:count])
    colours, bounds = ListedColormap(shades), np.arange(count + 1) + 0.5
    dots = axes.scatter(
        rate, ep_return, c=stage + 1, cmap=colours, s=30, edgecolors=MUTED,
        linewidths=0.6, norm=BoundaryNorm(bounds, count) if count > 1 else None,
        zorder=3, label="candidate",
    )  # fmt: skip
    _draw_chosen(axes, data, row)
    _draw_references(axes, data, row)
    figure = axes.get_figure()
    if count > 1 and figure is not None:
        bar = figure.colorbar(
            dots, ax=axes, ticks=range(1, count + 1), shrink=0.8, pad=0.02
        )
        bar.ax.tick_params(colors=MUTED, labelcolor=INK, labelsize=8.5, length=0)
        bar.set_label("stage", color=INK, fontsize=9)
        bar.outline.set_edgecolor(MUTED)  # pyright: ignore
    axes.margins(x=0.06, y=0.1)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -0.4), min(max(high, LEAST_SPAN), 104))
    _draw_front(axes, rate, ep_return)
    legend(axes, 2)
    name = algorithm_label(data.algorithms[row]).replace("$", r"\$")
    label_axes(axes, "violating episodes, %", f"{name}: return per episode")


def _draw_front(axes: "Axes", rate: Array, ep_return: Array) -> None:
    """Steps through the best trade-offs; what is below and to the right is beaten."""
    best = front(rate, ep_return)
    if not best.size:
        return
    (_, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    x = np.concatenate([rate[best[:1]], rate[best], [right]])
    y = np.concatenate([[bottom], ep_return[best], ep_return[best[-1:]]])
    axes.step(
        x, y, where="post", color=MUTED, lw=1.3, zorder=2, label="best trade-offs"
    )
    axes.set_ylim(bottom, top)


def _draw_chosen(axes: "Axes", data: ReportData, row: int) -> None:
    """A ring around the candidate that the search has chosen."""
    if data.best is None:
        return
    stage, index = data.stages[data.best.stage], data.best.index
    if stage.violation_rate is not None:
        axes.plot(
            100 * stage.violation_rate[row, index], stage.algorithm_return[row, index],
            "o", markersize=10, markerfacecolor="none", markeredgecolor=BEST,
            markeredgewidth=2, zorder=5, label="chosen as best",
        )  # fmt: skip


def _draw_references(axes: "Axes", data: ReportData, row: int) -> None:
    for cost, marker in MARKERS.items():
        rows = [
            (100 * one.violation_rate, one.ep_return)
            for one in data.references
            if one.cost == cost and one.algorithm == data.algorithms[row]
        ]
        x, y = np.array(rows, float).reshape(-1, 2).T
        known = np.isfinite(x) & np.isfinite(y)
        if not known.any():
            continue
        axes.plot(
            x[known], y[known], marker, linestyle="none", markersize=7, zorder=4,
            markerfacecolor=INK, markeredgecolor=PAPER, markeredgewidth=0.8,
        )  # fmt: skip
        at = int(np.nanargmax(np.where(known, y, -np.inf)))
        left = x[at] > 0.5 * axes.get_xlim()[1]  # of its mark, if that is on the right
        axes.annotate(
            COST_LABELS[cost], (x[at], y[at]), (-7 if left else 7, 3),
            textcoords="offset points", ha="right" if left else "left", fontsize=8.5,
            color=INK, zorder=6,
        )  # fmt: skip
