"""The report of a search: one self-contained HTML page, and its figures.

`render_report(data)` returns the page: script, style, pictures and data are inline,
nothing is loaded from a network, and it opens from a file. It takes plain data and
knows nothing of run directories. `tradeoff_figure`, `stage_scatter`, `learning_curves`
and `heat_map` return matplotlib figures for other documents.
"""

from collections.abc import Sequence
from pathlib import Path

from autocost_jax.files import write_atomic
from autocost_jax.viz.end import (
    outcome_section,
    tradeoff_section,
    verdict,
)
from autocost_jax.viz.figures import (
    heat_map,
    learning_curves,
    stage_scatter,
)
from autocost_jax.viz.markup import asset, escape, fill
from autocost_jax.viz.player import (
    comparison_page,
    replay_data,
    replay_script,
)
from autocost_jax.viz.replay import Replay
from autocost_jax.viz.report_data import (
    BestCandidate,
    Curve,
    ReferenceScore,
    ReportData,
    StageRecord,
    SummaryRow,
)
from autocost_jax.viz.sections import (
    best_section,
    config_section,
    curves_section,
    evolution_section,
    played,
    replay_section,
    stages_section,
)
from autocost_jax.viz.tradeoff import tradeoff_figure

__all__ = [
    "BestCandidate",
    "Curve",
    "ReferenceScore",
    "Replay",
    "ReportData",
    "StageRecord",
    "SummaryRow",
    "heat_map",
    "learning_curves",
    "render_report",
    "stage_scatter",
    "tradeoff_figure",
    "verdict",
    "write_comparison",
    "write_report",
]


def render_report(data: ReportData) -> str:
    """The report as one HTML document, of a size that grows with P x S.

    Args:
      data: what to show; every text in it is escaped.
    """
    makers = (
        outcome_section,
        tradeoff_section,
        replay_section,
        best_section,
        evolution_section,
        curves_section,
        stages_section,
        config_section,
    )
    sections = [make(data) for make in makers]
    replays = played(data)
    parts = {
        "title": escape(data.title),
        "style": asset("page.css"),
        "verdict": escape(verdict(data)),
        "sections": "\n".join(section for section in sections if section),
        "policies": "deterministic (mean actions)"
        if data.deterministic
        else "stochastic: actions are sampled, also in the scored episodes",
        "obstacle": escape(data.obstacle),
        "data": replay_data(replays) if replays else "",
        "script": replay_script(),
    }
    return fill(asset("page.html"), parts)


def write_report(data: ReportData, path: str | Path) -> Path:
    """Writes the report, creating its folder; returns the path of the file."""
    return _write(render_report(data), path)


def write_comparison(
    replays: Sequence[Replay], title: str, text: str, path: str | Path
) -> Path:
    """Writes one self-contained page with two replays side by side under one slider.

    Args:
      replays: at least two; the first two of different labels are shown first, and
        with more than two one can choose.
      title: heading of the page.
      text: what is to be seen, in plain words; blank lines part paragraphs.
      path: file; its folder is created.

    Returns:
      The path of the file.

    Raises:
      ValueError: fewer than two replays, or one without a step.
    """
    return _write(comparison_page(replays, title, text), path)


def _write(page: str, path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, page.encode())
    return path
