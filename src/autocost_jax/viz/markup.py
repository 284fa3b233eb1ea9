"""Small pieces of HTML that the report and the replay page share."""

import html
import importlib.resources
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def escape(value: Any) -> str:
    """HTML text in which nothing is markup, quotes included."""
    return html.escape(str(value), quote=True)


def number(value: float) -> str:
    """Three significant digits; a small cost never reads as 0."""
    value = float(value)
    if not math.isfinite(value):
        return "–"
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return text.replace("-", "−", 1) if text.startswith("-") else text


def percent(value: float) -> str:
    """A share as a percentage; a dash if it is unknown."""
    return f"{100 * value:.3g} %" if math.isfinite(value) else "–"


def section(name: str, title: str, lead: str, *content: str) -> str:
    """A section with a heading; `lead` and `content` are HTML."""
    lead = f'<p class="lead">{lead}</p>' if lead else ""
    return (
        f'<section id="{name}" aria-labelledby="{name}-title">'
        f'<h2 id="{name}-title">{title}</h2>{lead}{"".join(content)}</section>'
    )


def tiles(rows: list[tuple[str, str, str]]) -> str:
    """Facts at the top of a page: (name, value, note) as plain text."""
    cells = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd><dd>{escape(note)}</dd></div>"
        for name, value, note in rows
    )
    return f'<dl class="tiles">{cells}</dl>' if rows else ""


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    zero: Sequence[bool] = (),
    kind: str = "",
) -> str:
    """A table with row headers, of plain text; rows flagged in `zero` are marked."""
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


def asset(name: str) -> str:
    """The text of a file of this package."""
    folder = importlib.resources.files("autocost_jax.viz")
    return (folder / name).read_text(encoding="utf-8")


def fill(template: str, parts: Mapping[str, str]) -> str:
    """`{{name}}` replaced by its part.

    In one pass, so that braces inside a part are never taken for a name.
    """
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match.group(1)], template)


def data_block(name: str, value: Any) -> str:
    """A script element of strict JSON, which cannot close the element it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    text = text.replace("<", "\\u003c").replace("&", "\\u0026")
    return f'<script type="application/json" id="{name}">{text}</script>'
