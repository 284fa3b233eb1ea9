"""The paper's eleven claims: what decides each, ours, and a verdict.

    python experiments/claims.py   # results/claims.json and claims.md

Reads the committed results alone (`figures.py`, `computing_time.py`), those of the
paper's number of steps (`reduced_10m`: 9,990,000 a slot, networks and updates smaller
than the paper's): Goal-Hazard-Point with four hazards, and with eight beside it.

A claim is a list of sentences, each with the test that decides it. It is reproduced if
all of them hold, not if none does, else in part; and not measured where a result that
it needs is missing. `RULES` has the tests. They were written down before anything with
four hazards was trained for so long; with eight the results were known.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import compact
from paper import BOTH, CROWDED, FOLDERS, NAMES, RESULTS, WORLD, in_world

SCALE, EPISODES, LAYOUTS = "reduced_10m", 1000, 200
OPEN = 0.015  # rate of violations that none in 200 layouts leaves open (95 %)
LEAST = 1.0  # a return that is as good as none
RULES = f"""
Scores are those of the agents of five seeds in {LAYOUTS} fresh episodes each. All seeds
play the same {LAYOUTS} layouts, so that no violation among {EPISODES} episodes bounds
the rate of these agents by {OPEN:.1%} (exact, one-sided, 95 %).

- *at zero*: none of {EPISODES} episodes violates. *near zero*: at most 5 % do. *not at
  zero*: more than {OPEN:.1%} do.
- *a large drop* of return: at most half is left of what the extrinsic cost alone
  returns. *bad*: at most a quarter. *satisfying*: at least half. *much more* than
  another cost: at least 1.5 times as much. Returns below {LEAST:g} count as {LEAST:g}
  where they are compared with.
- *unchanged*: the 95 % bootstrap interval of the difference of the means over the seeds
  includes 0, for the return and for the cost.
- *about 0.5*: a mean cost from 0.25 to 1. *far fewer* violations: at most half.
  *learns nothing*: a mean return of at most {LEAST:g}.
- *the training cost never at zero*: the mean of each of the last 20 epochs is above 0.
  *the extrinsic cost at zero*: in at least half of these epochs no agent violates.
- the evolution, by the paper's rule, for each search seed: no candidate at zero in the
  first stage, more of them in the last than in the first, and a lower mean cost there.
- computing time is projected from benchmarks, and the paper does not say of how many
  agents its hours are: no verdict.
"""
WORDS = {True: "yes", False: "no", None: "not measured"}


class Scores(NamedTuple):
    """A design's agents of one algorithm.

    Attributes:
      row: of a result file, see `paper.scores`; None: not measured, or not with as many
        episodes as the tests ask for.
    """

    row: dict[str, Any] | None

    @property
    def known(self) -> dict[str, Any]:
        """The row, where there is one."""
        assert self.row is not None
        return self.row

    @property
    def rate(self) -> float:
        """Share of violating episodes."""
        return self.known["violations"] / self.known["episodes"]

    @property
    def ep_return(self) -> float:
        """Mean over the seeds."""
        return self.known["return"]["mean"]

    @property
    def ep_cost(self) -> float:
        """Mean over the seeds."""
        return self.known["cost"]["mean"]

    def last(self, name: str) -> np.ndarray:
        """[20] means over the seeds in the last epochs of training."""
        return np.asarray(self.known["curves"][name]["mean"][-20:])

    def __str__(self) -> str:
        if self.row is None:
            return "not measured"
        return (
            f"{self.row['violations']} of {self.row['episodes']} violate, cost "
            f"{self.ep_cost:.3f}, return {self.ep_return:.1f}"
        )


class Sentence(NamedTuple):
    """A part of a claim, and what decides it.

    Attributes:
      words: what the paper says.
      holds: scores of each design -> whether it does.
      algorithm: that trained the agents.
      designs: of `paper.DESIGNS`: the one that the sentence is of, and those that it is
        compared with.
      world: None for the one that the page is about.
    """

    words: str
    holds: Callable[..., bool]
    algorithm: str
    designs: tuple[str, ...]
    world: str | None = None


class Answer(NamedTuple):
    """A sentence that was put to the results.

    Attributes:
      words: what the paper says, and of what.
      holds: whether it does; None: not measured.
      measured: ours.
    """

    words: str
    holds: bool | None
    measured: str


Find = Callable[..., Scores]  # (design, algorithm, world) -> scores
PLAIN, FOUND = "extrinsic", "evolved"
CPO, PPO = "cpo", "ppo_lagrangian"
PILLARS, PUSH = "Goal-Pillar-Point", ("Push-Hazard-Point", "Push-Pillar-Point")
CAR, DOGGO = "Goal-Hazard-Car", "Goal-Hazard-Doggo"


def is_zero(scores: Scores) -> bool:
    """None of the episodes violates."""
    return scores.rate == 0


def is_near_zero(scores: Scores) -> bool:
    """At most 5 % of them do."""
    return scores.rate <= 0.05


def is_not_zero(scores: Scores) -> bool:
    """More of them do than none in as many layouts leaves open."""
    return scores.rate > OPEN


def keeps(share: float) -> Callable[[Scores, Scores], bool]:
    """At least a share of the return of other agents."""
    return lambda scores, other: scores.ep_return >= share * max(other.ep_return, LEAST)


def loses(share: float) -> Callable[[Scores, Scores], bool]:
    """At most a share of the return of other agents is left."""
    return lambda scores, other: scores.ep_return <= share * max(other.ep_return, LEAST)


def is_unchanged(scores: Scores, other: Scores) -> bool:
    """Neither return nor cost differ beyond their interval."""
    pairs = [(scores.known[key], other.known[key]) for key in ("return", "cost")]
    return all(includes_zero(a["seeds"], b["seeds"]) for a, b in pairs)


def includes_zero(a: Sequence[float], b: Sequence[float], draws: int = 10_000) -> bool:
    """Whether the bootstrap interval of mean(a) - mean(b) over seeds includes 0."""
    rng = np.random.default_rng(0)
    means = [rng.choice(np.asarray(x), (draws, len(x))).mean(1) for x in (a, b)]
    low, high = np.percentile(means[0] - means[1], [2.5, 97.5])
    return bool(low <= 0 <= high)


def is_always_paid(scores: Scores) -> bool:
    """The training cost is above zero in every one of the last epochs."""
    return bool((scores.last("ep_total_cost") > 0).all())


def comes_to_zero(scores: Scores) -> bool:
    """The extrinsic cost is zero in at least half of the last epochs."""
    return bool(np.mean(scores.last("ep_cost") == 0) >= 0.5)


def of_both(
    words: str, holds: Callable[..., bool], *designs: str, world: str | None = None
) -> list[Sentence]:
    """The same sentence on each of the two algorithms."""
    return [Sentence(words, holds, name, designs, world) for name in BOTH]


def found_in(world: str | None) -> list[Sentence]:
    """The found cost in one world, and the extrinsic cost alone."""
    return [
        *of_both("with the found cost at zero", is_zero, FOUND, world=world),
        *of_both("without it not at zero", is_not_zero, PLAIN, world=world),
    ]


COMING, CHANGE = "distance_decrease", "distance_change"
INDICATOR = "distance_change_indicator"
CLAIMS: dict[str, list[Sentence]] = {
    "Limits of 0.5 and 0": [
        *of_both(
            "with a limit of 0.5 the cost is about 0.5",
            lambda s: 0.25 <= s.ep_cost <= 1.0,
            "limit_0.5",
        ),
        *of_both("with a limit of 0 not at zero", is_not_zero, PLAIN),
    ],
    "Negative limits": [
        Sentence("at -0.1 near zero", is_near_zero, CPO, ("limit_-0.1",)),
        Sentence("at -1 at zero", is_zero, CPO, ("limit_-1",)),
        Sentence("at -1 a large drop of return", loses(0.5), CPO, ("limit_-1", PLAIN)),
        Sentence("at -1 unchanged", is_unchanged, PPO, ("limit_-1", PLAIN)),
    ],
    "The cost of coming closer": [
        Sentence("at zero", is_zero, CPO, (COMING,)),
        Sentence("a bad return", loses(0.25), CPO, (COMING, PLAIN)),
        Sentence("near zero", is_near_zero, PPO, (COMING,)),
        Sentence("a satisfying return", keeps(0.5), PPO, (COMING, PLAIN)),
    ],
    "The change of distance, and its indicator": [
        *of_both("with the change not at zero", is_not_zero, CHANGE),
        Sentence("with the indicator at zero", is_zero, CPO, (INDICATOR,)),
        Sentence("with the indicator near zero", is_near_zero, PPO, (INDICATOR,)),
        *of_both("with the indicator a bad return", loses(0.25), INDICATOR, PLAIN),
    ],
    "The evolution": [],  # `evolution` asks the searches
    "The found cost in other tasks and constraints": [
        part for world in (None, PILLARS, *PUSH) for part in found_in(world)
    ],
    "The found cost with other robots": [
        *of_both("at zero", is_zero, FOUND, world=CAR),
        Sentence("at zero", is_zero, PPO, (FOUND,), DOGGO),
        Sentence(
            "learns nothing", lambda s: s.ep_return <= LEAST, CPO, (FOUND,), DOGGO
        ),
    ],
    "What the found cost asks for, and what comes of it": [
        *of_both("the training cost is never at zero", is_always_paid, FOUND),
        *of_both("the extrinsic cost comes to zero", comes_to_zero, FOUND),
    ],
    "Margins": [
        *of_both("with 3x at zero", is_zero, "margin_3x"),
        *of_both("with 2x not at zero", is_not_zero, "margin_2x"),
        *of_both("with 1x not at zero", is_not_zero, "margin_1x"),
        *of_both("with the found cost at zero", is_zero, FOUND),
        *of_both(
            "the found cost returns much more than 3x", keeps(1.5), FOUND, "margin_3x"
        ),
    ],
    "Without the extrinsic cost": [
        *of_both(
            "far fewer violations than with the extrinsic cost alone",
            lambda scores, plain: scores.rate <= plain.rate / 2,
            "evolved_alone",
            PLAIN,
        ),
        *of_both("not at zero", is_not_zero, "evolved_alone"),
    ],
    "Computing time": [],  # `computing_time` asks the benchmarks
}


def load(file: Path) -> dict[str, Any]:
    """A result, empty where there is none."""
    return json.loads(file.read_text()) if file.exists() else {}


def finder(folder: Path, world: str) -> Find:
    """Of the scores in a folder of results; `world` is where a sentence names none."""
    panels: dict[str, dict[str, Any]] = {}
    for file in sorted(folder.glob("*.json")):
        for name, designs in load(file).get("worlds", {}).items():
            panels.setdefault(name, {}).update(designs)

    def find(design: str, algorithm: str, where: str | None) -> Scores:
        panel = panels.get(in_world(where, world) if where else world, {})
        row = panel.get(design, {}).get("algorithms", {}).get(algorithm)
        return Scores(row if row and row["episodes"] >= EPISODES else None)

    return find


def answer(part: Sentence, find: Find) -> Answer:
    """Put a sentence to the results."""
    found = [find(name, part.algorithm, part.world) for name in part.designs]
    is_known = all(scores.row is not None for scores in found)
    where = f"{part.world}, " if part.world else ""
    return Answer(
        f"{where}{NAMES[part.algorithm]}: {part.words}",
        bool(part.holds(*found)) if is_known else None,
        "; beside ".join(map(str, found)) if is_known else "not measured",
    )


def evolution(folder: Path) -> list[Answer]:
    """What the searches of the paper's rule say."""
    searches = load(folder / "evolution.json").get("searches", ())
    own = [search["cost"] for search in searches if search["rule"] == "paper"]
    zeros = [[sum(cost == 0 for cost in stage) for stage in stages] for stages in own]
    means = [[float(np.mean(stage)) for stage in stages] for stages in own]
    rows = (
        ("no candidate at zero in the first stage", zeros, lambda z: z[0] == 0),
        ("more of them later", zeros, lambda z: z[-1] > z[0]),
        ("the mean cost falls", means, lambda m: m[-1] < m[0]),
    )
    return [
        Answer(
            words,
            all(map(holds, values)) if own else None,
            "; ".join(", ".join(f"{x:g}" for x in each) for each in values)
            or "not measured",
        )
        for words, values, holds in rows
    ]


def computing_time(results: Path) -> list[Answer]:
    """The paper's hours of a task beside ours of one agent."""
    result = load(results / "computing_time.json")
    cells = [
        f"{world} {max(hours[PPO], hours[CPO]):.1f} h "
        f"({result['paper_hours'][world]} in the paper)"
        for world, hours in result.get("hours", {}).items()
    ]
    return [Answer("hours of an agent, projected", None, ", ".join(cells))]


def judged(results: Path, world: str) -> list[dict[str, Any]]:
    """Every claim in one world."""
    folder = results / FOLDERS[world] / SCALE
    find, rows = finder(folder, world), []
    others = {"The evolution": lambda: evolution(folder)}
    others["Computing time"] = lambda: computing_time(results)
    for claim, sentences in CLAIMS.items():
        answers = [answer(part, find) for part in sentences] or others[claim]()
        parts = [each._asdict() for each in answers]
        verdict_of = verdict([each.holds for each in answers])
        rows.append({"claim": claim, "verdict": verdict_of, "sentences": parts})
    return rows


def verdict(answers: Sequence[bool | None]) -> str:
    """Of a claim whose sentences hold or not, or are not measured."""
    if not answers or None in answers:
        return "not measured"
    if all(answers):
        return "reproduced"
    return "in part" if any(answers) else "not"


def table(result: dict[str, Any]) -> str:
    """claims.md: the verdicts, the rules, then the sentences of each claim."""
    worlds = result["worlds"]
    lines = [
        "# The paper's eleven claims",
        "",
        "After 9,990,000 steps a slot, networks and updates smaller than the paper's "
        f"(`{result['command']}`).",
        "",
        f"| claim | {' | '.join(worlds)} |",
        "|---" * (1 + len(worlds)) + "|",
    ]
    for rows in zip(*worlds.values(), strict=True):
        verdicts = " | ".join(row["verdict"] for row in rows)
        lines.append(f"| {rows[0]['claim']} | {verdicts} |")
    lines += ["", "## What decides", *result["rules"].rstrip().splitlines()]
    for world, rows in worlds.items():
        lines += ["", f"## {world}", "", "| claim | the paper | holds | ours |"]
        lines += ["|---|---|---|---|"]
        lines += [
            f"| {row['claim']} | {part['words']} | {WORDS[part['holds']]} | "
            f"{part['measured']} |"
            for row in rows
            for part in row["sentences"]
        ]
    return "\n".join(lines) + "\n"


def main(results: Path = RESULTS) -> None:
    """Write claims.json and claims.md."""
    worlds = {world: judged(results, world) for world in (WORLD, CROWDED)}
    command = "python experiments/claims.py"
    result = {"command": command, "rules": RULES, "worlds": worlds}
    (results / "claims.json").write_text(compact(result) + "\n")
    (results / "claims.md").write_text(table(result))


if __name__ == "__main__":
    main()
