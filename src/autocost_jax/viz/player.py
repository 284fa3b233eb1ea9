"""The HTML around replays: their controls and read-outs, and pages of their own."""

from collections.abc import Mapping, Sequence

import numpy as np

from autocost_jax.viz.markup import (
    asset,
    data_block,
    escape,
    fill,
    number,
    percent,
    section,
    tiles,
)
from autocost_jax.viz.replay import Replay, replay_json

VIEWS = {"follow": "close up", "3d": "all", "top": "all, from above"}
SPEEDS = ("0.25", "0.5", "1", "2", "4", "8")
THINGS = {  # look -> what the key says
    "hazards": "hazard: to be in it costs",
    "pillars": "pillar: to touch it costs",
    "vases": "vase: to touch or move it costs",
    "box": "box: to be pushed to the goal",
    "goal": "goal; it moves when it is met (green dots in the chart)",
}

_PLAYER = """<div class="player"><div class="panes{{one}}" id="panes">{{panes}}</div>
<div class="card controls" id="controls">
<button id="play" type="button">Play</button>
<input id="scrub" type="range" min="0" max="{{last}}" value="0" aria-label="Step">
<span class="now"><span id="now-step">–</span>, <span id="now-time">–</span></span>
<label>View <select id="view">{{views}}</select></label>
<label>Speed <select id="speed">{{speeds}}</select></label>
<label><input id="show-lidar" type="checkbox" checked> lidar</label>
<label><input id="show-trail" type="checkbox" checked> trail</label></div>
<ul class="key">{{key}}</ul>
<p class="hint">Drag turns the view, Ctrl + wheel zooms; in a focused view the space bar
plays, and the arrows go step by step.</p>
<noscript><p>The replay needs JavaScript.</p></noscript></div>"""

_PANE = """<div class="card pane" id="pane-{{i}}"><div class="pick">{{pick}}</div>
<p class="sum" id="sum-{{i}}">{{summary}}</p><div class="canvases">
<canvas class="world" id="world-{{i}}" role="img" aria-label="{{label}}" data-frame="0"
tabindex="0"></canvas>
<canvas class="timeline" id="timeline-{{i}}" role="img" aria-label="Return and extrinsic
cost so far, by step, as lines; steps with extrinsic cost as red bars. Click to jump.">
</canvas></div><dl class="readout">{{numbers}}</dl></div>"""

_NUMBERS = {  # name in the script -> what it is
    "return": "Return so far",
    "reward": "Reward now",
    "goals": "Goals met",
    "cost": "Extrinsic cost so far",
    "step-cost": "Extrinsic cost now",
    "hits": "Steps with a violation",
    "outside": "Outside the arena by",
    "away": "Time outside so far",
}
_INTRINSIC = {
    "intrinsic": "Intrinsic cost so far",
    "step-intrinsic": "Intrinsic cost now",
}


def replay_summary(replay: Replay) -> str:
    """Length, return, cost and time outside the arena, in one plain sentence."""
    cost, reward = (float(np.nansum(x)) for x in (replay.cost, replay.reward))
    hits = int(np.nansum(replay.violations))
    text = f"One episode of {replay.steps} steps; return {number(reward)}, "
    text += f"extrinsic cost {number(cost)} in {hits} steps" if hits else "no violation"
    outside = outside_share(replay)
    if outside > 0:
        text += f"; {percent(outside)} of the time outside the arena"
    return f"{text}."


def outside_share(replay: Replay) -> float:
    """Share of the frames after the start in which the robot is outside the arena."""
    x0, y0, x1, y1 = replay.extents
    x, y = replay.poses[1:, replay.robot, :2].T
    outside = (x < x0) | (x > x1) | (y < y0) | (y > y1)  # never where it is not finite
    return float(outside.mean()) if outside.size else 0.0


def first_pair(labels: Sequence[str]) -> tuple[int, int]:
    """Which replays are shown first, and beside each other.

    The best cost's comes first, beside it the same algorithm's with the extrinsic cost
    alone. Without such labels they are the first two.

    Args:
      labels: at least two, such as "CPO, best cost".
    """

    def find(word: str, algorithm: str, others: Sequence[int]) -> int:
        fits = [i for i in others if word in labels[i].lower()]
        same = [i for i in fits if labels[i].split(",")[0] == algorithm]
        return (same or fits or list(others))[0]

    everyone = range(len(labels))
    best = find("best", labels[0].split(",")[0], everyone)
    others = [i for i in everyone if i != best]
    return best, find("extrinsic", labels[best].split(",")[0], others)


def replay_panel(replays: Sequence[Replay]) -> str:
    """The canvases and controls that `replay.js` brings to life.

    Args:
      replays: at least one; with two or more there are two panes to choose for.
    """
    labels = [replay.label for replay in replays]
    shown = first_pair(labels) if len(replays) > 1 else (0,)
    parts = {
        "one": " one" * (len(shown) == 1),
        "panes": "".join(_pane(i, at, replays) for i, at in enumerate(shown)),
        "last": str(max(replays[at].steps for at in shown)),
        "views": _options(VIEWS, "follow"),
        "speeds": _options({speed: f"{speed} ×" for speed in SPEEDS}, "2"),
        "key": _key(replays),
    }
    return fill(_PLAYER, parts)


def _pane(i: int, chosen: int, replays: Sequence[Replay]) -> str:
    """The HTML of one pane; `chosen` is the index of the replay it shows first."""
    replay = replays[chosen]
    if len(replays) > 1:
        choices = {str(at): one.label for at, one in enumerate(replays)}
        choices |= {"-1": "nothing"} if i else {}
        options = _options(choices, str(chosen))
        word = "Compare with" if i else "Show"
        pick = f'<label>{word} <select id="pick-{i}">{options}</select></label>'
    else:
        pick = f"<strong>{escape(replay.label)}</strong>"
    has_intrinsic = any(one.intrinsic is not None for one in replays)
    numbers = [(*row, "") for row in _NUMBERS.items()]
    if has_intrinsic:
        numbers += [(*row, "of-intrinsic") for row in _INTRINSIC.items()]
    parts = {
        "i": str(i),
        "pick": pick,
        "summary": escape(replay_summary(replay)),
        "label": escape(f"{replay.label}. {replay_summary(replay)}"),
        "numbers": "".join(
            f'<div class="{kind}"><dt>{text}</dt><dd id="now-{name}-{i}">–</dd></div>'
            for name, text, kind in numbers
        ),
    }
    return fill(_PANE, parts)


def _key(replays: Sequence[Replay]) -> str:
    looks = {shape.look for replay in replays for shape in replay.shapes}
    entries = [
        *((f"var(--{look})", THINGS[look]) for look in THINGS if look in looks),
        (None, f"rings around the robot: what its lidars read ({_rings(replays[0])})"),
        ("var(--ink)", "thick line on the floor: border of the arena, not a wall"),
        ("var(--limit)", "violation: red frame, trail, bar; line: cost so far"),
        ("var(--best)", "line in the chart: return so far"),
    ]
    if any(replay.intrinsic is not None for replay in replays):
        entries.append(("var(--third)", "line in the chart: intrinsic cost per step"))
    return "".join(
        f'<li><i style="color:{colour or "var(--muted)"}"></i>{escape(text)}</li>'
        for colour, text in entries
    )


def replay_data(replays: Sequence[Replay]) -> str:
    """The script element that holds the recorded episodes."""
    rows = [
        {"summary": replay_summary(replay)} | replay_json(replay) for replay in replays
    ]
    return data_block("replay-data", rows)


def replay_script() -> str:
    """The script that draws them."""
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
    kicker = "autocost render: one episode, every geom where MuJoCo has it"
    rows = [(name, *fact) for name, fact in facts.items()]
    return _page(title, kicker, tiles(rows), (replay,))


def comparison_page(replays: Sequence[Replay], title: str, text: str) -> str:
    """One self-contained HTML document with two episodes side by side.

    Args:
      replays: at least two; see `first_pair` for which are shown first.
      title: heading of the page.
      text: what is to be seen, in plain words; blank lines part paragraphs.

    Raises:
      ValueError: fewer than two replays, or one without a step.
    """
    if len(replays) < 2:
        raise ValueError(f"replays must be at least two, got {len(replays)}")
    if not all(replay.steps for replay in replays):
        raise ValueError("replays must have at least one step each")
    paragraphs = (part.strip() for part in text.split("\n\n"))
    words = "".join(f"<p>{escape(part)}</p>" for part in paragraphs if part)
    kicker = "AutoCost: two episodes side by side, under one slider"
    return _page(title, kicker, words, replays)


def _page(title: str, kicker: str, top: str, replays: Sequence[Replay]) -> str:
    heading = "Replays" if len(replays) > 1 else "Replay"
    parts = {
        "title": escape(title),
        "style": asset("page.css"),
        "kicker": escape(kicker),
        "top": top,
        "replay": section("replay", heading, "", replay_panel(replays)),
        "data": replay_data(replays),
        "script": replay_script(),
    }
    return fill(asset("replay.html"), parts)


def _rings(replay: Replay) -> str:
    names = [name.removesuffix("s") for name in replay.lidars]
    return ", ".join(names) + ", from the inside out" * (len(names) > 1)


def _options(choices: Mapping[str, str], chosen: str) -> str:
    return "".join(
        f'<option value="{value}"{" selected" * (value == chosen)}>{escape(text)}'
        "</option>"
        for value, text in choices.items()
    )
