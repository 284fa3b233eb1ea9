"""The top of the report: did the search succeed, in words, a table and a figure."""

from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.viz.markup import escape, number, percent, section, table
from autocost_jax.viz.report_data import ReportData
from autocost_jax.viz.svg import figures
from autocost_jax.viz.tradeoff import candidates, front, tradeoff_panels

TOO_SHORT = (
    "The episodes of this run are too short to judge safety: nobody could violate in "
    "them."
)
OFTEN = 0.05  # of the steps; agents that drive past the border now and then stay below


def verdict(data: ReportData) -> str:
    """What came out of the search, in words."""
    text = data.conclusion or _from_stages(data)
    warned = data.can_violate or "too short" in text
    return text if warned else f"{TOO_SHORT} {text}"


def candidate_name(stage: int, index: int) -> str:
    """A candidate as people count: from 1; both arguments count from 0."""
    return f"candidate {index + 1} of stage {stage + 1}"


def _from_stages(data: ReportData) -> str:
    """Sentences for a run whose best cost no fresh seeds have judged."""
    if not data.stages:
        return "No stage has finished yet."
    first, last, count = data.stages[0], data.stages[-1], len(data.stages)
    if count == 1:
        text = (
            "After one stage the candidates' mean return per episode is "
            f"{number(first.mean_return)}, their mean extrinsic cost "
            f"{number(first.mean_cost)}."
        )
    else:
        text = (
            f"Over {count} stages the candidates' mean return per episode went from "
            f"{number(first.mean_return)} to {number(last.mean_return)}, their mean "
            f"extrinsic cost from {number(first.mean_cost)} to "
            f"{number(last.mean_cost)}."
        )
    if data.can_violate:
        zero = int(last.zero_violation.sum())
        text += (
            f" At the end of the last stage {zero} of its {len(last.cost)} candidates "
            "had no violation."
        )
    if data.best is None:
        return f"{text} Every candidate of a stage diverged, so there is no best cost."
    stage, index = data.stages[data.best.stage], data.best.index
    return (
        f"{text} Best so far: {candidate_name(data.best.stage, index)} (return "
        f"{number(stage.ep_return[index])}, extrinsic cost "
        f"{number(stage.cost[index])}). Fresh seeds have not judged it yet: this "
        "does not tell whether the search succeeded."
    )


def outcome_section(data: ReportData) -> str:
    """The summary: each cost's agents on fresh seeds, side by side."""
    if not data.summary:
        return ""
    names = [algorithm_label(name) for name in data.algorithms]
    head = ["agents trained with"]
    head += [f"{n}: {what}" for n in names for what in ("return", "violating episodes")]
    head.append("fresh seeds x episodes")
    cells = {(row.cost, row.algorithm): row for row in data.summary}
    rows, clean = [], []
    for cost, title in COST_LABELS.items():
        found = [cells.get((cost, name)) for name in data.algorithms]
        known = [row for row in found if row is not None]
        if not known:
            continue
        line = [title]
        for row in found:
            line.append("–" if row is None else number(row.ep_return))
            line.append("–" if row is None else _violating(row.violation_rate, data))
        sizes = dict.fromkeys(_size(row.seeds, row.episodes) for row in known)
        rows.append([*line, ", ".join(sizes)])
        clean.append(data.can_violate and all(row.violation_rate == 0 for row in known))
    caption = (
        "Mean return per episode, and the share of episodes with any extrinsic cost. "
        "A green bar marks a cost under which nobody violated."
    )
    notes = "".join(f"<p>{escape(text)}</p>" for text in _outside_notes(data))
    body = table(caption, head, rows, clean, "compact")
    lead = "Agents trained afresh with each cost, then judged in new episodes."
    return section("outcome", "Did it succeed?", lead, body, notes)


def _violating(rate: float, data: ReportData) -> str:
    return percent(rate) if data.can_violate else "episodes too short"


def _size(seeds: int, episodes: int) -> str:
    return f"{seeds} x {episodes:,}" if seeds and episodes else "–"


def _outside_notes(data: ReportData) -> list[str]:
    """Who leaves the arena often: a low cost out there is no safe driving."""
    notes = []
    for cost, title in COST_LABELS.items():
        often = [
            f"{algorithm_label(row.algorithm)} {percent(row.outside_share)}"
            for row in data.summary
            if row.cost == cost and row.outside_share > OFTEN
        ]
        if often:
            notes.append(
                f"With the {title} agents leave the arena, where nothing can be hit "
                f"and no goal be met: {', '.join(often)} of their time."
            )
    return notes


def tradeoff_section(data: ReportData) -> str:
    """Return against violations, one panel for each algorithm."""
    panels = tradeoff_panels(data)
    if not panels:
        return ""
    notes = {}
    for row, (name, _) in enumerate(panels):
        rate, ep_return, stage = candidates(data, row)
        ends = [
            f"return {number(float(ep_return[i]))} at {percent(float(rate[i]))} "
            f"(stage {stage[i] + 1})"
            for i in front(rate, ep_return)
        ]
        title = algorithm_label(name)
        notes[name] = (
            f"{title}: return against share of violating episodes. Best trade-offs: "
            f"{'; '.join(ends)}.",
            f"{title}. Upper left is better. No candidate beats those on the line in "
            "both return and violations.",
        )
    count = len(data.references)
    told = ""
    if count:
        told = (
            " The squares and triangles were trained beside them with costs that "
            "nobody evolved: a search that succeeds gets above and to the left of them."
        )
    lead = (
        "Every dot is an agent at the end of its training, under one candidate's cost."
        f"{told} One training says little: the same cost trained again may land "
        "elsewhere, so the pick of many flatters itself."
    )
    return section(
        "tradeoff",
        "Return against violations",
        lead,
        figures("tradeoff", panels, notes),
    )
