"""The report of a search: one self-contained HTML page, and its figures.

`render_report(data)` returns the page: script, style, pictures and data are inline,
nothing is loaded from a network, and it opens from a file. It takes plain data and
knows nothing of run directories. `stage_scatter`, `learning_curves` and `heat_map`
return matplotlib figures for other documents.
"""

import importlib.resources
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from autocost_jax.arrays import write_atomic
from autocost_jax.report_assets.cost_field import network_cost, object_lidar
from autocost_jax.report_assets.data import (
    TIMID_DISTANCE,
    BestCandidate,
    Curve,
    Evaluation,
    Replay,
    ReportData,
    StageRecord,
)
from autocost_jax.report_assets.figures import (
    heat_map,
    learning_curves,
    stage_scatter,
)
from autocost_jax.report_assets.sections import (
    best_section,
    config_section,
    curves_section,
    escape,
    evaluations_section,
    evolution_section,
    number,
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
    replay = ""
    if data.replay is not None and len(data.replay.cost):
        payload = _json(_replay_json(data.replay))
        replay = f'<script type="application/json" id="replay-data">{payload}</script>'
    parts = {
        "title": escape(data.title),
        "style": _asset("page.css"),
        "verdict": escape(verdict(data)),
        "tiles": _tiles(data),
        "sections": "\n".join(section for section in sections if section),
        "policies": "deterministic (mean actions)"
        if data.deterministic
        else "stochastic: actions are sampled, also in the scored episodes",
        "timid": escape(f"{TIMID_DISTANCE:g}"),
        "data": replay,
        "script": _asset("replay.js"),
    }
    # one pass, so that braces inside the data are never taken for a name
    return re.sub(r"\{\{(\w+)\}\}", lambda m: parts[m.group(1)], _asset("page.html"))


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
        return f"{text}; every candidate diverged, so there is no best cost."
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
        return f"{text}; the one shown as best has the lowest cost: {best}."
    return (
        f"{text}; no candidate of the search reached zero violations, and the one "
        f"with the lowest cost is {best}."
    )


def _control_clause(data: ReportData) -> str:
    if data.control_cost is None or not len(data.control_cost):
        return ""
    start, end = data.control_cost[0], data.control_cost[-1]
    return f" (with random selection: {number(start)} to {number(end)})"


def _asset(name: str) -> str:
    folder = importlib.resources.files("autocost_jax") / "report_assets"
    return (folder / name).read_text(encoding="utf-8")


def _json(value: Any) -> str:
    """Strict JSON that cannot close the script element it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("&", "\\u0026")


def _rounded(values: Any, digits: int) -> Any:
    """Nested lists; null where a number is not finite."""
    array = np.asarray(values, float)
    if array.ndim:
        return [_rounded(row, digits) for row in array]
    return round(float(array), digits) if np.isfinite(array) else None


def _replay_json(replay: Replay) -> dict[str, Any]:
    names = ("robot_xy", "robot_yaw", "goal_xy", "hazards", "extents", "box_xy")
    values: dict[str, Any] = {
        name: None if value is None else _rounded(value, 4)
        for name in names
        for value in [getattr(replay, name)]
    }
    for name in ("cost", "reward", "intrinsic"):
        values[name] = _rounded(getattr(replay, name), 6)
    for name in ("hazard_radius", "goal_radius", "box_size", "dt"):
        values[name] = float(getattr(replay, name))
    return values | {"constraint_lidar": _rounded(replay.constraint_lidar, 3)}


def _tiles(data: ReportData) -> str:
    tiles = []
    if data.stages:
        first, last = data.stages[0], data.stages[-1]
        arrow = f"{number(first.mean_cost)} → {number(last.mean_cost)}"
        tiles.append(
            (
                "Mean extrinsic cost",
                arrow,
                f"first and last of {len(data.stages)} stages",
            )
        )
        zeros = [int(stage.zero_violation.sum()) for stage in data.stages]
        size = len(last.cost)
        ever = f"{sum(zeros)} over all stages; {zeros[0]} in the first"
        tiles.append(("Zero violation, last stage", f"{zeros[-1]} of {size}", ever))
    if data.best is not None:
        stage, index = data.stages[data.best.stage], data.best.index
        scores = f"{number(stage.ep_return[index])} / {number(stage.cost[index])}"
        tiles.append(("Best: return / extrinsic cost", scores, data.best.label))
    if "duration" in data.config:
        known = [
            f"{data.config[key]} {key}" if key != "device" else data.config[key]
            for key in ("env steps", "steps/s", "device")
            if key in data.config
        ]
        tiles.append(("Duration", data.config["duration"], ", ".join(known)))
    cells = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd><dd>{escape(note)}</dd></div>"
        for name, value, note in tiles
    )
    return f'<dl class="tiles">{cells}</dl>' if tiles else ""
