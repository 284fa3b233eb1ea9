"""Drawings as inline SVG in the colours and fonts of the page."""

import io
import re
from collections.abc import Iterable, Mapping

from autocost_jax.viz.figures import (
    ALGORITHM_COLOURS,
    BEST,
    GRID,
    INK,
    LIMIT,
    MEAN,
    MUTED,
    PANEL_HEIGHT,
    PANEL_WIDTH,
    PAPER,
    ZERO,
    Draw,
    add_axes,
    make_figure,
)
from autocost_jax.viz.markup import escape

# on the page these become CSS variables, so that figures follow the dark mode
CSS_VARIABLES = {
    INK: "ink", MUTED: "muted", GRID: "grid", PAPER: "card", ZERO: "zero",
    BEST: "best", MEAN: "mean", LIMIT: "limit", ALGORITHM_COLOURS[2]: "third",
    ALGORITHM_COLOURS[3]: "fourth",
}  # fmt: skip


def panel_svg(draw: Draw, name: str, label: str) -> str:
    """A drawing as an inline `<svg>` that follows the page's colours.

    Args:
      draw: fills an `Axes`.
      name: prefix of the ids, unique on the page.
      label: text alternative, already escaped for an attribute.
    """
    import matplotlib

    figure = make_figure(PANEL_WIDTH, PANEL_HEIGHT)
    draw(add_axes(figure, 1, 1))
    buffer = io.StringIO()
    none = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=none)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    head, body = svg.split(">", 1)
    view = re.search(r'viewBox="[^"]*"', head)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'href="#', f'href="#{name}-', body)
    body = re.sub(r"url\(#", f"url(#{name}-", body)
    body = re.sub(r"(font: [^;\"]*?px) [^;\"]*", r"\1 var(--sans)", body)
    for colour, variable in CSS_VARIABLES.items():
        body = body.replace(colour, f"var(--{variable})")
    size = view.group(0) if view else ""
    return f'<svg {size} role="img" aria-label="{label}">{body}'


def figures(
    name: str,
    panels: Iterable[tuple[str, Draw]],
    notes: Mapping[str, tuple[str, str]],
    last: str = "",
) -> str:
    """Figures side by side.

    Args:
      name: prefix of their ids, unique on the page.
      panels: (key, drawing) of each.
      notes: key -> (alternative text, caption), plain text.
      last: HTML of a last cell.
    """
    out = []
    for key, draw in panels:
        label, caption = (escape(part) for part in notes[key])
        place = re.sub(r"[^a-z0-9]+", "-", key.lower())
        svg = panel_svg(draw, f"{name}-{place}", label)
        out.append(f"<figure>{svg}<figcaption>{caption}</figcaption></figure>")
    return f'<div class="grid">{"".join(out)}{last}</div>'
