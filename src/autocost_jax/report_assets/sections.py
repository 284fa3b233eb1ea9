"""The sections of the report's page; an empty string where there is no data."""

from collections.abc import Iterable, Sequence

import numpy as np

from autocost_jax.report_assets.data import ReportData
from autocost_jax.report_assets.figures import (
    NAMES,
    Draw,
    curve_panels,
    heat_panels,
    stage_panels,
)
from autocost_jax.report_assets.markup import escape, number, percent, section
from autocost_jax.report_assets.player import replay_panel, replay_summary
from autocost_jax.report_assets.svg import panel_svg


def _figures(
    name: str,
    panels: Iterable[tuple[str, Draw]],
    notes: dict[str, tuple[str, str]],
    last: str = "",
) -> str:
    """Figures side by side; `notes` gives the alternative text and the caption."""
    out = []
    for key, draw in panels:
        label, caption = (escape(part) for part in notes[key])
        svg = panel_svg(draw, f"{name}-{key.replace('_', '-')}", label)
        out.append(f"<figure>{svg}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="grid">{"".join(out)}{last}</div>'


def _table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    zero: Sequence[bool] = (),
    kind: str = "",
) -> str:
    """A table with row headers; rows flagged in `zero` are marked."""
    top = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    body = []
    for row, (first, *rest) in enumerate(rows):
        mark = ' class="zero"' if row < len(zero) and zero[row] else ""
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in rest)
        body.append(f'<tr{mark}><th scope="row">{escape(first)}</th>{cells}</tr>')
    head_row = f"<thead><tr>{top}</tr></thead>" if top else ""
    label = escape(caption)
    return (
        f'<div class="card table"><p class="caption">{label}</p>'
        f'<div class="scroll {kind}" tabindex="0" role="region" aria-label="{label}">'
        f'<table class="{kind}" aria-label="{label}">{head_row}'
        f"<tbody>{''.join(body)}</tbody></table></div></div>"
    )


def _series(values: Iterable[float]) -> str:
    return ", ".join(number(value) for value in values)


def evolution_section(data: ReportData) -> str:
    """Costs, returns and timid agents by stage."""
    if not data.stages:
        return ""
    stages = data.stages
    frozen = sum(int((~stage.finite).sum()) for stage in stages)
    lost = f" {frozen} diverged (crosses at the top)." if frozen else ""
    notes = {
        "cost": (
            "Extrinsic cost of every candidate by stage. Stage means: "
            f"{_series(stage.mean_cost for stage in stages)}.",
            "Every dot is a candidate: its extrinsic cost after training, mean over "
            "the algorithms (the highest, in a search that judges by the worst). The "
            f"red line is zero violation.{lost}",
        ),
        "return": (
            "Return of every candidate by stage. Stage means: "
            f"{_series(stage.mean_return for stage in stages)}.",
            "The same candidates' returns: what safety costs in performance.",
        ),
        "timid": (
            "Share of agents that hardly move, by stage, in percent: "
            f"{_series(100 * stage.timid_share for stage in stages)}.",
            f"The timid solution: avoiding every {data.obstacle} by standing still.",
        ),
    }
    return section(
        "evolution",
        "Evolution",
        "How the population changed from stage to stage.",
        _figures("evolution", stage_panels(data), notes),
    )


def best_section(data: ReportData) -> str:
    """Heat map, profile, card and parameters of the best candidate."""
    best = data.best
    if best is None:
        return ""
    name = data.obstacle
    notes = {
        "map": (
            f"Heat map of the best intrinsic cost over robot positions around a {name} "
            "at the origin, which is drawn as a circle.",
            f"The robot looks along +x; a single {name} (circle) stands at the origin. "
            "Lidar of 8 bins, exponential, gain 1. The scale starts at 0.",
        ),
        "profile": (
            f"The same cost against the distance to the {name}'s centre.",
            f"A real world has several {name}s, and few bins ever read 0: far away "
            "is not the same as alone.",
        ),
    }
    panels = heat_panels(best.theta, data.obstacle_radius, name)
    where = f"Stage {best.stage + 1}, candidate {best.index}: {best.label}."
    theta = "\n".join(
        "  ".join(f"{value: .6g}" for value in best.theta[i : i + 4])
        for i in range(0, len(best.theta), 4)
    )
    stage = data.stages[best.stage]
    scores = (
        f"return {number(stage.ep_return[best.index])}",
        f"extrinsic cost {number(stage.cost[best.index])}",
    )
    lines = "".join(f"<li>{escape(line)}</li>" for line in (*scores, *best.card))
    card = (
        f'<div class="card"><h3>Its card</h3><ul class="facts">{lines}</ul>'
        f"<details><summary>Its {len(best.theta)} parameters</summary><p>W1 (rows of "
        f"4), b1, W2, b2:</p><pre>{escape(theta)}</pre></details></div>"
    )
    figures = _figures("best", panels, notes, card)
    return section("best", "The best cost", escape(where), figures)


def replay_section(data: ReportData) -> str:
    """An episode of the best policy."""
    if data.replay is None or not data.replay.steps:
        return ""
    lead = f"{data.replay.label}. {replay_summary(data.replay)}".removeprefix(". ")
    body = replay_panel(data.replay)
    return section("replay", "Replay of the best policy", escape(lead), body)


def evaluations_section(data: ReportData) -> str:
    """The table of fresh evaluation episodes."""
    if not data.evaluations:
        return ""
    rows = [
        [
            row.label,
            f"{number(row.return_mean)} ± {number(row.return_ci)}",
            f"{number(row.cost_mean)} ± {number(row.cost_ci)}",
            percent(row.violation_rate),
            f"{row.episodes:,}",
        ]
        for row in data.evaluations
    ]
    head = ["policy", "return", "extrinsic cost", "episodes in violation", "episodes"]
    caption = "Mean and half-width of the 95 % interval over episodes."
    table = _table(
        caption, head, rows, [r.violation_rate == 0 for r in data.evaluations]
    )
    return section("evaluation", "Evaluation on fresh episodes", "", table)


def curves_section(data: ReportData) -> str:
    """Learning curves of all stages."""
    if not data.curves:
        return ""
    caption = (
        "Median over the candidates; the band holds the middle half. Long stages are "
        "shown as means over blocks of epochs."
    )
    notes = {
        key: (f"Learning curves: {name} by epoch.", f"{note} {caption}")
        for key, name, note in (
            ("ep_return", "return", "Return of an episode."),
            ("ep_cost", "extrinsic cost", "What a candidate is scored on."),
            ("ep_total_cost", "total cost", "Extrinsic + intrinsic: what is learnt."),
        )
    }
    return section(
        "learning",
        "Learning curves",
        "Agents start from scratch in every stage (dotted lines).",
        _figures("learning", curve_panels(data), notes),
    )


def stages_section(data: ReportData) -> str:
    """One row a stage, and every candidate in a fold."""
    if not data.stages:
        return ""
    head = ["stage", "candidates", "mean cost", "median cost", "lowest cost",
            "mean return", "zero violation", "diverged", "timid agents",
            "selected"]  # fmt: skip
    rows = []
    for place, stage in enumerate(data.stages, 1):
        cost = stage.cost[stage.finite]
        rows.append([
            str(place), str(len(stage.cost)), number(stage.mean_cost),
            number(np.median(cost) if cost.size else np.nan),
            number(np.min(cost, initial=np.inf)), number(stage.mean_return),
            str(int(stage.zero_violation.sum())), str(int((~stage.finite).sum())),
            percent(stage.timid_share), ", ".join(str(int(i)) for i in stage.elites),
        ])  # fmt: skip
    caption = "Costs are extrinsic, an episode; selected candidates stand best first."
    details = (
        f"<details><summary>Every candidate</summary>{_candidates(data)}</details>"
    )
    return section("stages", "Stages", "", _table(caption, head, rows), details)


def _candidates(data: ReportData) -> str:
    names = [NAMES.get(name, name) for name in data.algorithms]
    head = ["stage / candidate", "cost", "return"]
    head += [f"{name} {what}" for name in names for what in ("cost", "return")]
    head += ["intrinsic far", "intrinsic near", "selected"]
    rows, zero = [], []
    for place, stage in enumerate(data.stages, 1):
        ranks = {int(i): str(rank) for rank, i in enumerate(stage.elites, 1)}
        for i in range(len(stage.cost)):
            row = [
                f"{place} / {i}",
                number(stage.cost[i]),
                number(stage.ep_return[i]),
            ]
            for a in range(len(names)):
                row.append(number(stage.algorithm_cost[a, i]))
                row.append(number(stage.algorithm_return[a, i]))
            for values in (stage.far_cost, stage.near_cost):
                row.append("–" if values is None else number(values[i]))
            rows.append([*row, ranks.get(i, "")])
            zero.append(bool(stage.zero_violation[i]))
    caption = "A green bar marks zero violation; – a diverged agent or no such state."
    return _table(caption, head, rows, zero, "tall")


def config_section(data: ReportData) -> str:
    """The configuration table, with how the policies act."""
    policies = "deterministic (mean action)" if data.deterministic else "sampled"
    rows = [*data.config.items(), ("policies", f"{policies} actions")]
    if data.deterministic:
        rows[-1] = ("policies", policies)
    table = _table("What was run.", [], rows, kind="plain")
    return section("config", "Configuration", "", table)
