"""The report of a search: one self-contained HTML page, and its figures.

`render_report(data)` returns the page: script, style, pictures and data are inline,
nothing is loaded from a network, and it opens from a file. It takes plain data and
knows nothing of run directories. `stage_scatter`, `learning_curves` and `heat_map`
return matplotlib figures for other documents.
"""

from pathlib import Path

from autocost_jax.arrays import write_atomic
from autocost_jax.report_assets.cost_field import network_cost, object_lidar
from autocost_jax.report_assets.data import (
    TIMID_DISTANCE,
    BestCandidate,
    Curve,
    Evaluation,
    ReportData,
    StageRecord,
)
from autocost_jax.report_assets.figures import (
    heat_map,
    learning_curves,
    stage_scatter,
)
from autocost_jax.report_assets.markup import asset, escape, fill, number, tiles
from autocost_jax.report_assets.player import replay_data, replay_script
from autocost_jax.report_assets.replay import Replay
from autocost_jax.report_assets.sections import (
    best_section,
    config_section,
    curves_section,
    evaluations_section,
    evolution_section,
    replay_section,
    stages_section,
)

__all__ = [
    "BestCandidate",
    "Curve",
    "Evaluation",
    "Replay",
    "ReportData",
    "StageRecord",
    "heat_map",
    "learning_curves",
    "network_cost",
    "object_lidar",
    "render_report",
    "stage_scatter",
    "verdict",
    "write_report",
]


def render_report(data: ReportData) -> str:
    """The report as one HTML document, of a size that grows with P x S.

    Args:
      data: what to show; every text in it is escaped.
    """
    makers = (
        evolution_section,
        best_section,
        replay_section,
        evaluations_section,
        curves_section,
        stages_section,
        config_section,
    )
    sections = [make(data) for make in makers]
    replay = data.replay if data.replay is not None and data.replay.steps else None
    parts = {
        "title": escape(data.title),
        "style": asset("page.css"),
        "verdict": escape(verdict(data)),
        "tiles": _tiles(data),
        "sections": "\n".join(section for section in sections if section),
        "policies": "deterministic (mean actions)"
        if data.deterministic
        else "stochastic: actions are sampled, also in the scored episodes",
        "timid": escape(f"{TIMID_DISTANCE:g}"),
        "obstacle": escape(data.obstacle),
        "data": "" if replay is None else replay_data(replay),
        "script": replay_script(),
    }
    return fill(asset("page.html"), parts)


def write_report(data: ReportData, path: str | Path) -> Path:
    """Writes the report, creating its folder; returns the path of the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, render_report(data).encode())
    return path


def verdict(data: ReportData) -> str:
    """What came out of the search, in one plain sentence made of its numbers."""
    if not data.stages:
        return "No stage has finished yet."
    first, last, count = data.stages[0], data.stages[-1], len(data.stages)
    zero_first, zero_last = (int(s.zero_violation.sum()) for s in (first, last))
    any_zero = any(stage.zero_violation.any() for stage in data.stages)
    if count == 1:
        text = (
            "After one stage the candidates' mean extrinsic cost of an episode is "
            f"{number(first.mean_cost)}"
        )
        reached = f", and {zero_first} of {len(first.cost)} reached zero violations"
    else:
        text = (
            f"Over {count} stages the candidates' mean extrinsic cost of an episode "
            f"went from {number(first.mean_cost)} to {number(last.mean_cost)}"
            f"{_control_clause(data)}"
        )
        reached = (
            f", and the number with zero violations from {zero_first} of "
            f"{len(first.cost)} to {zero_last} of {len(last.cost)}"
        )
    text += reached if any_zero else ""
    if data.best is None:
        return f"{text}; every candidate of a stage diverged, so there is no best cost."
    stage, index = data.stages[data.best.stage], data.best.index
    best = (
        f"candidate {index} of stage {data.best.stage + 1} (return "
        f"{number(stage.ep_return[index])}, extrinsic cost {number(stage.cost[index])})"
    )
    if stage.zero_violation[index]:
        return (
            f"{text}; the zero-violation candidate with the highest return is {best}."
        )
    if any_zero:
        return f"{text}; the one shown as best has the {data.best.label}: {best}."
    return (
        f"{text}; no candidate of the search reached zero violations, and the one "
        f"with the {data.best.label} is {best}."
    )


def _control_clause(data: ReportData) -> str:
    if data.control_cost is None or not len(data.control_cost):
        return ""
    start, end = data.control_cost[0], data.control_cost[-1]
    return f" (with random selection: {number(start)} to {number(end)})"


def _tiles(data: ReportData) -> str:
    rows = []
    if data.stages:
        first, last = data.stages[0], data.stages[-1]
        arrow = f"{number(first.mean_cost)} → {number(last.mean_cost)}"
        rows.append(
            (
                "Mean extrinsic cost",
                arrow,
                f"first and last of {len(data.stages)} stages",
            )
        )
        zeros = [int(stage.zero_violation.sum()) for stage in data.stages]
        size = len(last.cost)
        ever = f"{sum(zeros)} over all stages; {zeros[0]} in the first"
        rows.append(("Zero violation, last stage", f"{zeros[-1]} of {size}", ever))
    if data.best is not None:
        stage, index = data.stages[data.best.stage], data.best.index
        scores = f"{number(stage.ep_return[index])} / {number(stage.cost[index])}"
        rows.append(("Best: return / extrinsic cost", scores, data.best.label))
    if "duration" in data.config:
        known = [
            f"{data.config[key]} {key}" if key != "device" else data.config[key]
            for key in ("env steps", "steps/s", "device")
            if key in data.config
        ]
        rows.append(("Duration", data.config["duration"], ", ".join(known)))
    return tiles(rows)
