"""The HTML around a replay: its controls and read-outs, and a page of its own."""

from collections.abc import Mapping

import numpy as np

from autocost_jax.report_assets.markup import (
    asset,
    data_block,
    escape,
    fill,
    number,
    section,
    tiles,
)
from autocost_jax.report_assets.replay import Replay, replay_json

VIEWS = {"3d": "3-D", "follow": "3-D, follows", "top": "from above"}
SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")
THINGS = {  # look -> what the key says
    "hazards": "hazard: to be in it costs",
    "pillars": "pillar: to touch it costs",
    "vases": "vase: to touch or move it costs",
    "box": "box: to be pushed to the goal",
    "goal": "goal; it moves when it is met (green dots in the chart)",
}

_PANEL = """<div class="stage"><div class="card">
<canvas id="world" role="img" aria-label="{{label}}" data-frame="0" tabindex="0">
</canvas>
<canvas id="timeline" role="img" aria-label="Return and extrinsic cost so far, by step,
as lines; steps with extrinsic cost as red bars. Click to jump."></canvas>
<div class="controls"><button id="play" type="button">Play</button>
<input id="scrub" type="range" min="0" max="{{last}}" value="0" aria-label="Step"></div>
<div class="controls"><label>View <select id="view">{{views}}</select></label>
<label>Speed <select id="speed">{{speeds}}</select></label>
<label><input id="show-lidar" type="checkbox" checked> lidar</label>
<label><input id="show-trail" type="checkbox" checked> trail</label>
<span class="hint">drag turns, Ctrl + wheel zooms; space, arrows</span></div>
</div><div class="card"><dl class="readout">
<dt>Step</dt><dd id="now-step">–</dd><dt>Time</dt><dd id="now-time">–</dd>
<dt>Reward now</dt><dd id="now-reward">–</dd>
<dt>Return so far</dt><dd id="now-return">–</dd>
<dt>Goals met</dt><dd id="now-goals">–</dd>
<dt>Extrinsic cost now</dt><dd id="now-step-cost">–</dd>
<dt>Extrinsic cost so far</dt><dd id="now-cost">–</dd>
<dt>Steps with a violation</dt><dd id="now-hits">–</dd>{{intrinsic}}</dl>
<ul class="key">{{key}}</ul>
<noscript><p>The replay needs JavaScript.</p></noscript></div></div>"""

_INTRINSIC = """
<dt>Intrinsic cost now</dt><dd id="now-step-intrinsic">–</dd>
<dt>Intrinsic cost so far</dt><dd id="now-intrinsic">–</dd>"""


def replay_summary(replay: Replay) -> str:
    """Length, return and cost in one plain sentence."""
    cost, reward = (float(np.nansum(x)) for x in (replay.cost, replay.reward))
    return (
        f"One episode of {replay.steps} steps; return {number(reward)}, "
        f"extrinsic cost {number(cost)}."
    )


def replay_panel(replay: Replay) -> str:
    """The canvases and controls that `replay.js` brings to life."""
    looks = {shape.look for shape in replay.shapes}
    constrained = [look for look in THINGS if look in looks]
    entries = [
        *((f"var(--{look})", THINGS[look]) for look in constrained),
        (None, f"rings around the robot: what its lidars read ({_rings(replay)})"),
        ("var(--limit)", "violation: red frame, trail, bar; line: cost so far"),
        ("var(--best)", "line in the chart: return so far"),
    ]
    if replay.intrinsic is not None:
        entries.append(("var(--third)", "line in the chart: intrinsic cost a step"))
    key = "".join(
        f'<li><i style="color:{colour or "var(--muted)"}"></i>{escape(text)}</li>'
        for colour, text in entries
    )
    parts = {
        "label": escape(replay_summary(replay)),
        "last": str(len(replay.poses) - 1),
        "views": _options(VIEWS, "3d"),
        "speeds": _options({speed: f"{speed} ×" for speed in SPEEDS}, "2"),
        "intrinsic": "" if replay.intrinsic is None else _INTRINSIC,
        "key": key,
    }
    return fill(_PANEL, parts)


def replay_data(replay: Replay) -> str:
    """The script element that holds the recorded episode."""
    return data_block("replay-data", replay_json(replay))


def replay_script() -> str:
    """The script that draws it."""
    return asset("view.js") + asset("replay.js")


def replay_page(
    title: str, facts: Mapping[str, tuple[str, str]], replay: Replay
) -> str:
    """One self-contained HTML document.

    Args:
      title: such as "Goal-Hazard-Point, random policy".
      facts: name -> (value, note) of the tiles at the top.
      replay: the episode.
    """
    lead = escape(replay_summary(replay))
    parts = {
        "title": escape(title),
        "style": asset("page.css"),
        "tiles": tiles([(name, *fact) for name, fact in facts.items()]),
        "replay": section("replay", "Replay", lead, replay_panel(replay)),
        "data": replay_data(replay),
        "script": replay_script(),
    }
    return fill(asset("replay.html"), parts)


def _rings(replay: Replay) -> str:
    names = [name.removesuffix("s") for name in replay.lidars]
    return ", ".join(names) + ", from the inside out" * (len(names) > 1)


def _options(choices: Mapping[str, str], chosen: str) -> str:
    return "".join(
        f'<option value="{value}"{" selected" * (value == chosen)}>{text}</option>'
        for value, text in choices.items()
    )
