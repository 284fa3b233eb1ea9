"""The sections of the report's page; an empty string where there is no data."""

from collections.abc import Iterable

import numpy as np

from autocost_jax.runs.labels import algorithm_label
from autocost_jax.viz.diagnosis import describe_cost
from autocost_jax.viz.end import TOO_SHORT, candidate_name
from autocost_jax.viz.figures import (
    curve_panels,
    heat_panels,
    stage_panels,
)
from autocost_jax.viz.markup import escape, number, percent, section, table
from autocost_jax.viz.player import replay_panel
from autocost_jax.viz.replay import Replay
from autocost_jax.viz.report_data import ReportData
from autocost_jax.viz.svg import figures


def _series(values: Iterable[float]) -> str:
    return ", ".join(number(value) for value in values)


def evolution_section(data: ReportData) -> str:
    """Costs, returns and the time outside the arena, by stage."""
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
            f"red line is zero.{lost}",
        ),
        "return": (
            "Return of every candidate by stage. Stage means: "
            f"{_series(stage.mean_return for stage in stages)}.",
            "The same candidates' returns: what safety costs in performance.",
        ),
        "outside": (
            "Share of the steps that agents spend outside the arena, by stage, in "
            f"percent: {_series(100 * stage.mean_outside_share for stage in stages)}.",
            "Fleeing is no safe driving: outside the arena there is no "
            f"{data.obstacle} to hit and no goal to meet.",
        ),
    }
    return section(
        "evolution",
        "Evolution",
        "How the population changed from stage to stage."
        + ("" if data.can_violate else f" {TOO_SHORT}"),
        figures("evolution", stage_panels(data), notes),
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
            f"The robot's place; {_facing(data)}. A single {name} (circle) stands at "
            "the origin. Lidar of 8 bins, exponential, gain 1. The scale starts at 0.",
        ),
        "profile": (
            f"The same cost against the distance to the {name}'s centre.",
            f"A real world has several {name}s, and few bins ever read 0: far away "
            "is not the same as alone.",
        ),
    }
    panels = heat_panels(best.theta, data.obstacle_radius, name)
    name_of_best = candidate_name(best.stage, best.index)
    where = f"{name_of_best[0].upper()}{name_of_best[1:]}"
    # A label may speak of zero violations, which short episodes do not show.
    where += f": {best.label}." if data.can_violate else "."
    drawn = figures("best", panels, notes, _card(data))
    verdict = f'<div class="diagnosis">{_list(_diagnosis(data))}</div>'
    return section("best", "The best cost", escape(where), verdict, drawn)


def _diagnosis(data: ReportData) -> list[str]:
    """What is wrong with the best cost."""
    best = data.best
    if best is None:
        return []
    stage = data.stages[best.stage]
    far, near = (
        np.nan if values is None else float(values[best.index])
        for values in (stage.far_cost, stage.near_cost)
    )
    return describe_cost(
        best.theta,
        data.obstacle_radius,
        far,
        near,
        obstacle=data.obstacle,
        heading=_heading(data),
    )


def _facing(data: ReportData) -> str:
    """How the robot stands in the map."""
    heading = _heading(data)
    if heading is None:
        return "its x axis points along +x everywhere"
    quarter = round(heading / (np.pi / 2)) % 4
    return f"it faces {('+x', '+y', '−x', '−y')[quarter]} everywhere"


def _heading(data: ReportData) -> float | None:
    """What is ahead in the robot's frame, as `Replay.heading`; None if unknown."""
    return data.replays[0].heading if data.replays else None


def _card(data: ReportData) -> str:
    """The best cost's scores and parameters."""
    best = data.best
    if best is None:
        return ""
    stage = data.stages[best.stage]
    scores = (
        f"return at the end of its stage: {number(stage.ep_return[best.index])}",
        f"extrinsic cost there: {number(stage.cost[best.index])}",
    )
    theta = "\n".join(
        "  ".join(f"{value: .6g}" for value in best.theta[i : i + 4])
        for i in range(0, len(best.theta), 4)
    )
    return (
        f'<div class="card"><h3>Its card</h3>{_list((*scores, *best.card))}'
        f"<details><summary>Its {len(best.theta)} parameters</summary><p>W1 (rows of "
        f"4), b1, W2, b2:</p><pre>{escape(theta)}</pre></details></div>"
    )


def _list(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul class="facts">{items}</ul>'


def replay_section(data: ReportData) -> str:
    """Recorded episodes, two beside each other where there are two."""
    shown = played(data)
    if not shown:
        return ""
    lead = "Recorded episodes; actions are sampled unless the label says otherwise."
    if len(shown) > 1:
        lead += " Both run under one slider."
    return section("replay", "Replays", lead, replay_panel(shown))


def played(data: ReportData) -> tuple[Replay, ...]:
    """The replays that have a step."""
    return tuple(replay for replay in data.replays if replay.steps)


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
            ("ep_return", "return", "Return per episode."),
            ("ep_cost", "extrinsic cost", "What a candidate is scored on."),
            ("ep_total_cost", "total cost", "Extrinsic + intrinsic: what is learnt."),
        )
    }
    return section(
        "learning",
        "Learning curves",
        "Agents start from scratch in every stage (dotted lines).",
        figures("learning", curve_panels(data), notes),
    )


def stages_section(data: ReportData) -> str:
    """One row a stage, and every candidate in a fold."""
    if not data.stages:
        return ""
    head = ["stage", "candidates", "mean cost", "median cost", "lowest cost",
            "mean return", "violating episodes", "no violation", "time outside",
            "diverged", "selected"]  # fmt: skip
    rows = []
    for place, stage in enumerate(data.stages, 1):
        cost, judged = stage.cost[stage.finite], data.can_violate
        rows.append([
            str(place), str(len(stage.cost)), number(stage.mean_cost),
            number(np.median(cost) if cost.size else np.nan),
            number(np.min(cost, initial=np.inf)), number(stage.mean_return),
            percent(stage.mean_violation_rate) if judged else "–",
            str(int(stage.zero_violation.sum())) if judged else "–",
            percent(stage.mean_outside_share), str(int((~stage.finite).sum())),
            ", ".join(str(int(i) + 1) for i in stage.elites),
        ])  # fmt: skip
    caption = (
        "Costs are extrinsic, per episode; no violation: how many candidates had none "
        "at the end of training; selected candidates stand best first."
    )
    caption += "" if data.can_violate else f" {TOO_SHORT}"
    details = (
        f"<details><summary>Every candidate</summary>{_candidates(data)}</details>"
    )
    return section("stages", "Stages", "", table(caption, head, rows), details)


def _candidates(data: ReportData) -> str:
    names = [algorithm_label(name) for name in data.algorithms]
    head = ["stage / candidate", "cost", "return"]
    head += [f"{name} {what}" for name in names for what in ("cost", "return")]
    head += ["intrinsic far", "intrinsic near", "selected"]
    rows, zero = [], []
    for place, stage in enumerate(data.stages, 1):
        ranks = {int(i): str(rank) for rank, i in enumerate(stage.elites, 1)}
        for i in range(len(stage.cost)):
            row = [
                f"{place} / {i + 1}",
                number(stage.cost[i]),
                number(stage.ep_return[i]),
            ]
            for a in range(len(names)):
                row.append(number(stage.algorithm_cost[a, i]))
                row.append(number(stage.algorithm_return[a, i]))
            for values in (stage.far_cost, stage.near_cost):
                row.append("–" if values is None else number(values[i]))
            rows.append([*row, ranks.get(i, "")])
            zero.append(bool(stage.zero_violation[i]) and data.can_violate)
    caption = "– is a diverged agent, or no such state."
    if data.can_violate:
        caption += " A green bar marks a candidate without a violation."
    return table(caption, head, rows, zero, "tall")


def config_section(data: ReportData) -> str:
    """The configuration table, with how the policies act."""
    policies = "deterministic (mean action)" if data.deterministic else "sampled"
    rows = [*data.config.items(), ("policies", f"{policies} actions")]
    if data.deterministic:
        rows[-1] = ("policies", policies)
    body = table("What was run.", [], rows, kind="plain")
    return section("config", "Configuration", "", body)
