"""Figures of a search, drawn with matplotlib but without pyplot's global state.

`stage_scatter`, `learning_curves` and `heat_map` return a `Figure` to save as PNG or
PDF; `*_panels` give the same drawings one by one, for the page.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.viz.cost_map import Array, network_cost, object_lidar
from autocost_jax.viz.report_data import (
    ReportData,
    finite_mean,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID, PAPER = "#1c2430", "#5b6675", "#e3e7ec", "#fefefe"
ZERO, BEST, MEAN, LIMIT = "#00815a", "#0b62a8", "#b84a06", "#b3261e"
ALGORITHM_COLOURS = (BEST, MEAN, "#7a3f9d", "#4d5b1f")
PANEL_WIDTH, PANEL_HEIGHT = 4.2, 3.3  # inches
CURVE_POINTS = 60
WIDE_COST = 20.0  # above it a cost axis is logarithmic beyond 1
Draw = Callable[["Axes"], Any]


def stage_scatter(data: ReportData) -> "Figure":
    """The paper's evolution figure, the returns, and the time outside the arena."""
    return draw_row([draw for _, draw in stage_panels(data)])


def learning_curves(data: ReportData) -> "Figure":
    """Return, extrinsic and total cost by epoch, consecutive stages along x."""
    return draw_row([draw for _, draw in curve_panels(data)])


def heat_map(theta: Array, radius: float, obstacle: str = "hazard") -> "Figure":
    """The evolved cost around one obstacle at the origin, and its radial profile.

    Args:
      theta: [D] parameters of the network.
      radius: of the obstacle, metres.
      obstacle: what to call it.
    """
    return draw_row([draw for _, draw in heat_panels(theta, radius, obstacle)])


def stage_panels(data: ReportData) -> list[tuple[str, Draw]]:
    """(name, drawing) of each panel of `stage_scatter`."""
    panels: list[tuple[str, Draw]] = [
        ("cost", lambda axes: _draw_stage_cost(axes, data)),
        ("return", lambda axes: _draw_stage_return(axes, data)),
    ]
    if any(np.isfinite(stage.mean_outside_share) for stage in data.stages):
        panels.append(("outside", lambda axes: _draw_outside(axes, data)))
    return panels


def curve_panels(data: ReportData) -> list[tuple[str, Draw]]:
    """(name, drawing) of each panel of `learning_curves`."""

    def panel(field: str, label: str) -> tuple[str, Draw]:
        return field, lambda axes: _draw_curves(axes, data, field, label)

    return [
        panel("ep_return", "return per episode"),
        panel("ep_cost", "extrinsic cost per episode"),
        panel("ep_total_cost", "total cost per episode"),
    ]


def heat_panels(theta: Array, radius: float, obstacle: str) -> list[tuple[str, Draw]]:
    """(name, drawing) of each panel of `heat_map`."""
    return [
        ("map", lambda axes: _draw_heat(axes, theta, radius)),
        ("profile", lambda axes: _draw_profile(axes, theta, radius, obstacle)),
    ]


def make_figure(width: float, height: float) -> "Figure":
    """An empty figure, in inches, that pyplot does not know."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=150, layout="constrained")


def add_axes(figure: "Figure", columns: int, number: int) -> "Axes":
    """Axes in the report's style: cell `number`, from 1, of a row of `columns`."""
    axes = figure.add_subplot(1, columns, number)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=8.5, length=3)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    return axes


def draw_row(draws: list[Draw]) -> "Figure":
    """A figure of panels side by side."""
    figure = make_figure(PANEL_WIDTH * len(draws), PANEL_HEIGHT)
    for number, draw in enumerate(draws, 1):
        draw(add_axes(figure, len(draws), number))
    return figure


def label_axes(axes: "Axes", x: str, y: str) -> None:
    """Names both axes in the report's style."""
    axes.set_xlabel(x, color=INK, fontsize=9)
    axes.set_ylabel(y, color=INK, fontsize=9)


def legend(axes: "Axes", columns: int = 3) -> None:
    """A legend above the axes, if anything has a name."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            handles, labels, loc="lower left", bbox_to_anchor=(-0.02, 1.0),
            ncol=columns, frameon=False, fontsize=8.5, labelcolor=INK,
            handlelength=1.4, handletextpad=0.5, columnspacing=1.1,
        )  # fmt: skip


def _cost_axis(axes: "Axes", values: Array, label: str) -> str:
    """Scales y for costs; returns the axis label, which says if it is logarithmic."""
    values = values[np.isfinite(values)]
    top = float(values.max()) if values.size else 1.0
    low = float(values.min()) if values.size else 0.0
    if top <= WIDE_COST:
        span = max(top, 0.1)
        axes.set_ylim(min(-0.04 * span, 1.1 * low), 1.12 * span)
        return label
    from matplotlib.ticker import FuncFormatter

    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(min(-0.12, 1.1 * low), 2.2 * top)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))
    return f"{label} (log above 1)"


def _stage_ticks(axes: "Axes", stages: int) -> None:
    axes.set_xlim(0.45, max(stages, 1) + 0.55)
    axes.set_xticks(range(1, stages + 1))


def _spread(number: int, size: int) -> Array:
    """[P] x positions around a stage's tick, by candidate, so that dots stay apart."""
    return number + (np.linspace(-0.26, 0.26, size) if size > 1 else np.zeros(1))


def _draw_dots(axes: "Axes", data: ReportData, values_by_stage: list[Array]) -> None:
    """A dot for each candidate; `values_by_stage` holds [P] arrays."""
    for number, stage in enumerate(data.stages, 1):
        values, finite = values_by_stage[number - 1], stage.finite
        x = _spread(number, len(values))
        elite = np.isin(np.arange(len(values)), stage.elites)
        zero = stage.zero_violation.astype(bool) & data.can_violate
        for chosen, edge, face, width in (
            (~zero & ~elite, MUTED, PAPER, 0.8),
            (~zero & elite, INK, PAPER, 1.7),
            (zero & ~elite, ZERO, ZERO, 0.8),
            (zero & elite, INK, ZERO, 1.7),
        ):
            pick = chosen & finite
            axes.scatter(
                x[pick], values[pick], s=26, facecolors=face, edgecolors=edge,
                linewidths=width, zorder=3, clip_on=False,
            )  # fmt: skip
        if not finite.all():
            axes.plot(
                x[~finite], np.full((~finite).sum(), 0.98), "x", color=LIMIT,
                markersize=5, transform=axes.get_xaxis_transform(), clip_on=False,
            )  # fmt: skip


def _dot_legend(axes: "Axes", data: ReportData) -> None:
    """Adds the legend entries of the kinds of dots that occur."""
    zero = any(stage.zero_violation.any() for stage in data.stages) & data.can_violate
    frozen = any(not stage.finite.all() for stage in data.stages)
    kinds = [("o", PAPER, MUTED, 0.8, "candidate"), ("o", PAPER, INK, 1.7, "selected")]
    if zero:
        kinds.append(("o", ZERO, ZERO, 0.8, "no violation"))
    if frozen:
        kinds.append(("x", LIMIT, LIMIT, 1.2, "diverged"))
    for marker, face, edge, width, label in kinds:
        axes.plot(
            [], [], marker, markersize=5.2, markerfacecolor=face,
            markeredgecolor=edge, markeredgewidth=width, label=label,
        )  # fmt: skip


def _reference(axes: "Axes", data: ReportData, field: str, scale: float = 1.0) -> None:
    """A line through the stages' agents that had the extrinsic cost alone."""
    rows = [row for row in data.references if row.cost == "extrinsic"]
    stages = sorted({row.stage for row in rows if row.stage < len(data.stages)})
    means = [
        scale * finite_mean([getattr(row, field) for row in rows if row.stage == stage])
        for stage in stages
    ]
    if np.isfinite(means).any():
        x = np.array(stages) + 1
        label = COST_LABELS["extrinsic"]
        axes.plot(x, means, "s--", color=MUTED, lw=1.4, markersize=4, label=label)


def _draw_stage_cost(axes: "Axes", data: ReportData) -> None:
    stages = data.stages
    x = np.arange(1, len(stages) + 1)
    best = [np.min(s.cost[s.finite], initial=np.inf) for s in stages]
    best = [value if np.isfinite(value) else np.nan for value in best]
    values = np.concatenate([s.cost[s.finite] for s in stages] or [np.zeros(0)])
    label = _cost_axis(axes, values, "extrinsic cost per episode")
    axes.axhline(0, color=LIMIT, lw=1.2, zorder=1)
    _draw_dots(axes, data, [s.cost for s in stages])
    axes.plot(x, [s.mean_cost for s in stages], color=MEAN, lw=2, label="mean")
    axes.plot(x, best, color=BEST, lw=2, label="lowest")
    _reference(axes, data, "ep_cost")
    _dot_legend(axes, data)
    legend(axes)
    _stage_ticks(axes, len(stages))
    label_axes(axes, "stage", label)


def _draw_stage_return(axes: "Axes", data: ReportData) -> None:
    stages = data.stages
    x = np.arange(1, len(stages) + 1)
    elite = []
    for stage in stages:
        chosen = np.isin(np.arange(len(stage.cost)), stage.elites) & stage.finite
        elite.append(np.mean(stage.ep_return[chosen]) if chosen.any() else np.nan)
    _draw_dots(axes, data, [s.ep_return for s in stages])
    axes.plot(x, [s.mean_return for s in stages], color=MEAN, lw=2, label="mean")
    axes.plot(x, elite, color=BEST, lw=2, label="mean of the selected")
    _reference(axes, data, "ep_return")
    legend(axes)
    _stage_ticks(axes, len(stages))
    label_axes(axes, "stage", "return per episode")


def _draw_outside(axes: "Axes", data: ReportData) -> None:
    stages = data.stages
    shares = [
        np.full(len(stage.cost), np.nan)
        if stage.outside_share is None
        else 100 * np.array([finite_mean(column) for column in stage.outside_share.T])
        for stage in stages
    ]
    x = np.arange(1, len(stages) + 1)
    _draw_dots(axes, data, shares)
    axes.plot(x, [finite_mean(s) for s in shares], color=MEAN, lw=2, label="mean")
    _reference(axes, data, "outside_share", 100)
    axes.set_ylim(-4, 109)
    axes.set_yticks([0, 25, 50, 75, 100])
    legend(axes)
    _stage_ticks(axes, len(stages))
    label_axes(axes, "stage", "time outside the arena, %")


def _quartiles(values: Array) -> Array:
    """[3, E] quartiles over the finite candidates of each epoch; NaN without any."""
    rows = [row[np.isfinite(row)] for row in np.asarray(values, float)]
    quartiles = [
        np.percentile(row, [25, 50, 75]) if row.size else np.full(3, np.nan)
        for row in rows
    ]
    return np.array(quartiles).reshape(-1, 3).T


def _blocks(*series: Array) -> list[Array]:
    """Means over blocks of epochs, so that a stage has at most `CURVE_POINTS`."""
    size = -(-len(series[0]) // CURVE_POINTS)
    starts = np.arange(0, len(series[0]), max(size, 1))
    return [
        np.array([finite_mean(values[i : i + size]) for i in starts])
        for values in series
    ]


def _draw_curves(axes: "Axes", data: ReportData, field: str, label: str) -> None:
    stages = 1 + max((curve.stage for curve in data.curves), default=-1)
    length = np.zeros(stages + 1, int)
    for curve in data.curves:
        length[curve.stage + 1] = max(length[curve.stage + 1], len(curve.epoch))
    start = np.cumsum(length)
    drawn, seen = [np.zeros(0)], set()
    for curve in data.curves:
        kind = data.algorithms.index(curve.algorithm)
        colour = ALGORITHM_COLOURS[kind % len(ALGORITHM_COLOURS)]
        name = algorithm_label(curve.algorithm).replace("$", r"\$")
        x = start[curve.stage] + 1 + np.arange(len(curve.epoch))
        x, low, middle, high = _blocks(x, *_quartiles(getattr(curve, field)))
        drawn += [low, high]
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
        first = name if name not in seen else None
        axes.plot(x, middle, color=colour, lw=1.6, label=first)
        seen.add(name)
    for number in range(stages):
        if number:
            axes.axvline(start[number] + 0.5, color=MUTED, lw=0.8, ls=":")
        axes.annotate(
            f"stage {number + 1}" if stages <= 4 else f"{number + 1}",
            ((start[number] + start[number + 1] + 1) / 2, 1), (0, -9),
            xycoords=axes.get_xaxis_transform(), textcoords="offset points",
            ha="center", fontsize=8, color=MUTED,
        )  # fmt: skip
    if field != "ep_return":
        label = _cost_axis(axes, np.concatenate(drawn), label)
    axes.margins(x=0.02, y=0.1)
    legend(axes)
    label_axes(axes, "epoch, counted through the stages", label)


def _draw_heat(axes: "Axes", theta: Array, radius: float) -> None:
    from matplotlib.patches import Circle

    reach = 4 * radius
    side = np.linspace(-reach, reach, 161)
    robot = np.stack(np.meshgrid(side, side), -1)
    cost = network_cost(theta, object_lidar(-robot))
    edge = reach + (side[1] - side[0]) / 2
    image = axes.imshow(
        cost, origin="lower", extent=(-edge, edge, -edge, edge), cmap="viridis",
        vmin=0.0, vmax=max(float(cost.max()), 1e-12), interpolation="bilinear",
    )  # fmt: skip
    axes.add_patch(Circle((0, 0), radius, fill=False, color="white", lw=1.8))
    axes.add_patch(Circle((0, 0), radius, fill=False, color="black", lw=0.7))
    axes.grid(visible=False)
    figure = axes.get_figure()
    if figure is not None:
        bar = figure.colorbar(image, ax=axes, shrink=0.95, pad=0.03)
        bar.ax.tick_params(colors=MUTED, labelcolor=INK, labelsize=8.5, length=3)
        bar.set_label("intrinsic cost per step", color=INK, fontsize=9)
        bar.outline.set_edgecolor(MUTED)  # pyright: ignore
    label_axes(axes, "robot x, m", "robot y, m")


def _draw_profile(axes: "Axes", theta: Array, radius: float, obstacle: str) -> None:
    distance = np.linspace(0, 6 * radius, 181)[:, None]
    bearing = np.linspace(-np.pi, np.pi, 144, endpoint=False)
    ego = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], -1)
    cost = network_cost(theta, object_lidar(ego))
    x = distance[:, 0]
    inside = f"inside the {obstacle}"
    axes.axvspan(0, radius, color=LIMIT, alpha=0.1, lw=0, label=inside)
    axes.fill_between(
        x, cost.min(1), cost.max(1), color=BEST, alpha=0.18, lw=0, label="range"
    )
    axes.plot(x, cost.mean(1), color=BEST, lw=2, label="mean over bearings")
    axes.set_ylim(0, 1.05 * max(float(cost.max()), 1e-12))
    axes.set_xlim(0, x[-1])
    legend(axes)
    label_axes(
        axes, f"distance to the {obstacle}'s centre, m", "intrinsic cost per step"
    )
