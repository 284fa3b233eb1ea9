"""The report of a search: one self-contained HTML page, and its figures.

`render_report(data)` returns the page: script, style, pictures and data are inline,
nothing is loaded from a network, and it opens from a file. It takes plain data and
knows nothing of run directories. `stage_scatter`, `learning_curves` and `heat_map`
return matplotlib figures for other documents.
"""

import html
import importlib.resources
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autocost_jax.report_assets.data import (
    TIMID_DISTANCE,
    BestCandidate,
    Curve,
    Evaluation,
    Replay,
    ReportData,
    StageRecord,
    network_cost,
    object_lidar,
)
from autocost_jax.report_assets.figures import (
    NAMES,
    Draw,
    curve_panels,
    heat_map,
    heat_panels,
    learning_curves,
    panel_svg,
    stage_panels,
    stage_scatter,
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
    sections = [
        _evolution(data), _best(data), _replay(data), _evaluations(data),
        _curves(data), _stages(data), _config(data),
    ]  # fmt: skip
    replay = ""
    if data.replay is not None:
        payload = _json(_replay_json(data.replay))
        replay = f'<script type="application/json" id="replay-data">{payload}</script>'
    parts = {
        "title": _text(data.title),
        "style": _asset("page.css"),
        "verdict": _text(verdict(data)),
        "tiles": _tiles(data),
        "sections": "\n".join(section for section in sections if section),
        "policies": "deterministic (mean actions)"
        if data.deterministic
        else "stochastic: actions are sampled, also in the scored episodes",
        "timid": _text(f"{TIMID_DISTANCE:g}"),
        "data": replay,
        "script": _asset("replay.js"),
    }
    # one pass, so that braces inside the data are never taken for a name
    return re.sub(r"\{\{(\w+)\}\}", lambda m: parts[m.group(1)], _asset("page.html"))


def write_report(data: ReportData, path: str | Path) -> Path:
    """Writes the report, creating its folder; returns the path of the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_report(data), encoding="utf-8")
    return path


def verdict(data: ReportData) -> str:
    """What came out of the search, in one plain sentence made of its numbers."""
    if not data.stages:
        return "No stage has finished yet."
    first, last, count = data.stages[0], data.stages[-1], len(data.stages)
    zero_first, zero_last = (int(s.zero_violation.sum()) for s in (first, last))
    if count == 1:
        text = (
            f"After one stage the mean extrinsic cost of an episode is "
            f"{_number(first.mean_cost)} and {zero_first} of {len(first.cost)} "
            "candidates ended with zero violations"
        )
    else:
        text = (
            f"Over {count} stages the candidates' mean extrinsic cost of an episode "
            f"went from {_number(first.mean_cost)} to {_number(last.mean_cost)}"
            f"{_control_clause(data)}, and the candidates with zero violations "
            f"from {zero_first} of {len(first.cost)} to {zero_last} of "
            f"{len(last.cost)}"
        )
    if data.best is None:
        return f"{text}; every candidate diverged, so there is no best cost."
    stage, index = data.stages[data.best.stage], data.best.index
    scores = (
        f"stage {data.best.stage + 1}, candidate {index}, with return "
        f"{_number(stage.ep_return[index])} and extrinsic cost "
        f"{_number(stage.cost[index])}"
    )
    if any(s.zero_violation.any() for s in data.stages):
        kind = "best with zero violations by return"
        if not stage.zero_violation[index]:
            kind = "best by lowest cost"
        return f"{text}; the {kind} is {scores}."
    return (
        f"{text}; no candidate of the search reached zero violations, and the one "
        f"with the lowest cost is {scores}."
    )


def _control_clause(data: ReportData) -> str:
    if data.control_cost is None or not len(data.control_cost):
        return ""
    start, end = data.control_cost[0], data.control_cost[-1]
    return f" (with random selection: {_number(start)} to {_number(end)})"


def _text(value: Any) -> str:
    return html.escape(str(value), quote=True)


def _asset(name: str) -> str:
    folder = importlib.resources.files("autocost_jax") / "report_assets"
    return (folder / name).read_text(encoding="utf-8")


def _number(value: float) -> str:
    """Three significant digits; a small cost never reads as 0."""
    value = float(value)
    if not math.isfinite(value):
        return "–"
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return text.replace("-", "−", 1) if text.startswith("-") else text


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %" if math.isfinite(value) else "–"


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


def _section(name: str, title: str, lead: str, *content: str) -> str:
    lead = f'<p class="lead">{lead}</p>' if lead else ""
    return (
        f'<section id="{name}" aria-labelledby="{name}-title">'
        f'<h2 id="{name}-title">{title}</h2>{lead}{"".join(content)}</section>'
    )


def _figures(
    name: str, panels: Iterable[tuple[str, Draw]], notes: dict[str, tuple[str, str]]
) -> str:
    """Figures side by side; `notes` gives the alternative text and the caption."""
    out = []
    for key, draw in panels:
        label, caption = (_text(part) for part in notes[key])
        svg = panel_svg(draw, f"{name}-{key.replace('_', '-')}", label)
        out.append(f"<figure>{svg}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="grid">{"".join(out)}</div>'


def _table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    zero: Sequence[bool] = (),
    kind: str = "",
) -> str:
    """A table with row headers; rows flagged in `zero` are marked."""
    top = "".join(f'<th scope="col">{_text(cell)}</th>' for cell in head)
    body = []
    for number, (first, *rest) in enumerate(rows):
        mark = ' class="zero"' if number < len(zero) and zero[number] else ""
        cells = "".join(f"<td>{_text(cell)}</td>" for cell in rest)
        body.append(f'<tr{mark}><th scope="row">{_text(first)}</th>{cells}</tr>')
    head_row = f"<thead><tr>{top}</tr></thead>" if top else ""
    return (
        f'<div class="scroll {kind}" tabindex="0" role="region" '
        f'aria-label="{_text(caption)}"><table class="{kind}">'
        f"<caption>{_text(caption)}</caption>{head_row}"
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _tiles(data: ReportData) -> str:
    tiles = []
    if data.stages:
        first, last = data.stages[0], data.stages[-1]
        arrow = f"{_number(first.mean_cost)} → {_number(last.mean_cost)}"
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
        scores = f"{_number(stage.ep_return[index])} / {_number(stage.cost[index])}"
        tiles.append(("Best: return / extrinsic cost", scores, data.best.label))
    if "duration" in data.config:
        known = [
            f"{data.config[key]} {key}" if key != "device" else data.config[key]
            for key in ("env steps", "steps/s", "device")
            if key in data.config
        ]
        tiles.append(("Duration", data.config["duration"], ", ".join(known)))
    cells = "".join(
        f"<div><dt>{_text(name)}</dt><dd>{_text(value)}</dd><dd>{_text(note)}</dd></div>"
        for name, value, note in tiles
    )
    return f'<dl class="tiles">{cells}</dl>' if tiles else ""


def _series(values: Iterable[float]) -> str:
    return ", ".join(_number(value) for value in values)


def _evolution(data: ReportData) -> str:
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
            f"the algorithms. The red line is zero violation.{lost}",
        ),
        "return": (
            "Return of every candidate by stage. Stage means: "
            f"{_series(stage.mean_return for stage in stages)}.",
            "The same candidates' returns: what safety costs in performance.",
        ),
        "timid": (
            "Share of agents that hardly move, by stage, in percent: "
            f"{_series(100 * stage.timid_share for stage in stages)}.",
            "The timid solution: agents that avoid hazards by standing still.",
        ),
    }
    return _section(
        "evolution",
        "Evolution",
        "How the population changed from stage to stage.",
        _figures("evolution", stage_panels(data), notes),
    )


def _best(data: ReportData) -> str:
    best = data.best
    if best is None:
        return ""
    notes = {
        "map": (
            "Heat map of the best intrinsic cost over robot positions around a hazard "
            "at the origin, which is drawn as a circle.",
            "The robot looks along +x; a single hazard (circle) stands at the origin. "
            "Lidar of 8 bins, exponential, gain 1. The scale starts at 0.",
        ),
        "profile": (
            "The same cost against the distance to the hazard's centre.",
            "A real world has several hazards, and few bins ever read 0: far away "
            "is not the same as alone.",
        ),
    }
    panels = heat_panels(best.theta, data.hazard_radius)
    lines = "".join(f"<li>{_text(line)}</li>" for line in best.card)
    where = f"Stage {best.stage + 1}, candidate {best.index}: {best.label}."
    theta = "\n".join(
        "  ".join(f"{value: .6g}" for value in best.theta[i : i + 4])
        for i in range(0, len(best.theta), 4)
    )
    return _section(
        "best",
        "The best cost",
        _text(where),
        _figures("best", panels, notes),
        f'<details open><summary>Its card</summary><div class="card">'
        f'<ul class="facts">{lines}</ul></div></details>'
        if lines
        else "",
        "<details><summary>Its 41 parameters</summary>"
        '<div class="card"><p>W1 (8 rows of 4), b1, W2, b2:</p>'
        f"<pre>{_text(theta)}</pre></div></details>",
    )


_REPLAY = """<div class="stage"><div class="card">
<canvas id="world" role="img" aria-label="{label}" data-frame="0"></canvas>
<canvas id="timeline" role="img" aria-label="Intrinsic cost by step as a line; steps
with extrinsic cost as red bars. Click to jump."></canvas>
<div class="controls"><button id="play" type="button">Play</button>
<input id="scrub" type="range" min="0" max="{last}" value="0" aria-label="Step">
<label>Speed <select id="speed"><option value="0.5">0.5 ×</option>
<option value="1">1 ×</option><option value="2" selected>2 ×</option>
<option value="4">4 ×</option><option value="8">8 ×</option></select></label></div>
</div><div class="card"><dl class="readout">
<dt>Step</dt><dd id="now-step">–</dd><dt>Time</dt><dd id="now-time">–</dd>
<dt>Return so far</dt><dd id="now-return">–</dd>
<dt>Goals reached</dt><dd id="now-goals">–</dd>
<dt>Extrinsic cost so far</dt><dd id="now-cost">–</dd>
<dt>Steps with a violation</dt><dd id="now-hits">–</dd>
<dt>Intrinsic cost so far</dt><dd id="now-intrinsic">–</dd>
<dt>Intrinsic cost now</dt><dd id="now-step-intrinsic">–</dd></dl>
<ul class="key"><li><i style="color:var(--hazard)"></i>hazard; around the robot: what
its 8 lidar bins read</li><li><i style="color:var(--goal)"></i>goal; it moves when it
is met</li><li><i style="color:var(--limit)"></i>violation: red frame, trail, bar</li>
<li><i style="color:var(--best)"></i>timeline: intrinsic cost a step</li></ul>
<noscript><p>The replay needs JavaScript.</p></noscript></div></div>"""


def _replay(data: ReportData) -> str:
    replay = data.replay
    if replay is None or not len(replay.cost):
        return ""
    cost, reward = (float(np.nansum(x)) for x in (replay.cost, replay.reward))
    label = (
        f"One episode from above, {len(replay.cost)} steps; return "
        f"{_number(reward)}, extrinsic cost {_number(cost)}."
    )
    parts = {"label": _text(label), "last": str(len(replay.cost) - 1)}
    body = re.sub(r"\{(\w+)\}", lambda m: parts[m.group(1)], _REPLAY)
    lead = f"{replay.label}. {label}" if replay.label else label
    return _section("replay", "Replay of the best policy", _text(lead), body)


def _evaluations(data: ReportData) -> str:
    if not data.evaluations:
        return ""
    rows = [
        [
            row.label,
            f"{_number(row.return_mean)} ± {_number(row.return_ci)}",
            f"{_number(row.cost_mean)} ± {_number(row.cost_ci)}",
            _percent(row.violation_rate),
            f"{row.episodes:,}",
        ]
        for row in data.evaluations
    ]
    head = ["policy", "return", "extrinsic cost", "episodes in violation", "episodes"]
    caption = "Mean and half-width of the 95 % interval over episodes."
    table = _table(
        caption, head, rows, [r.violation_rate == 0 for r in data.evaluations]
    )
    return _section("evaluation", "Evaluation on fresh episodes", "", table)


def _curves(data: ReportData) -> str:
    if not data.curves:
        return ""
    caption = "Median over the candidates; the band holds the middle half."
    notes = {
        key: (f"Learning curves: {name} by epoch.", f"{note} {caption}")
        for key, name, note in (
            ("ep_return", "return", "Return of an episode."),
            ("ep_cost", "extrinsic cost", "What a candidate is scored on."),
            ("ep_total_cost", "total cost", "Extrinsic + intrinsic: what is learnt."),
        )
    }
    return _section(
        "learning",
        "Learning curves",
        "Agents start from scratch in every stage (dotted lines).",
        _figures("learning", curve_panels(data), notes),
    )


def _stages(data: ReportData) -> str:
    if not data.stages:
        return ""
    head = ["stage", "candidates", "mean cost", "median cost", "lowest cost",
            "mean return", "zero violation", "diverged", "timid agents",
            "selected, best first"]  # fmt: skip
    rows = []
    for number, stage in enumerate(data.stages, 1):
        cost = stage.cost[stage.finite]
        rows.append([
            str(number), str(len(stage.cost)), _number(stage.mean_cost),
            _number(np.median(cost) if cost.size else np.nan),
            _number(np.min(cost, initial=np.inf)), _number(stage.mean_return),
            str(int(stage.zero_violation.sum())), str(int((~stage.finite).sum())),
            _percent(stage.timid_share), ", ".join(str(int(i)) for i in stage.elites),
        ])  # fmt: skip
    caption = "One row a stage; costs are extrinsic, an episode."
    details = (
        f"<details><summary>Every candidate</summary>{_candidates(data)}</details>"
    )
    return _section("stages", "Stages", "", _table(caption, head, rows), details)


def _candidates(data: ReportData) -> str:
    names = [NAMES.get(name, name) for name in data.algorithms]
    head = ["stage / candidate", "cost", "return"]
    head += [f"{name} {what}" for name in names for what in ("cost", "return")]
    head += ["intrinsic far", "intrinsic near", "selected"]
    rows, zero = [], []
    for number, stage in enumerate(data.stages, 1):
        ranks = {int(i): str(rank) for rank, i in enumerate(stage.elites, 1)}
        for i in range(len(stage.cost)):
            row = [
                f"{number} / {i}",
                _number(stage.cost[i]),
                _number(stage.ep_return[i]),
            ]
            for a in range(len(names)):
                row.append(_number(stage.algorithm_cost[a, i]))
                row.append(_number(stage.algorithm_return[a, i]))
            for values in (stage.far_cost, stage.near_cost):
                row.append("–" if values is None else _number(values[i]))
            rows.append([*row, ranks.get(i, "")])
            zero.append(bool(stage.zero_violation[i]))
    caption = "A green bar marks zero violation; – a diverged agent or no such state."
    return _table(caption, head, rows, zero, "tall")


def _config(data: ReportData) -> str:
    policies = "deterministic (mean action)" if data.deterministic else "sampled"
    rows = [*data.config.items(), ("policies", f"{policies} actions")]
    if data.deterministic:
        rows[-1] = ("policies", policies)
    table = _table("What was run.", [], rows, kind="plain")
    return _section("config", "Configuration", "", table)
