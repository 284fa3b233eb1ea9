"""The paper's eleven claims: what decides each, ours, and a verdict.

    python experiments/claims.py   # results/claims.json and claims.md

Reads the committed results alone (`figures.py`, `computing_time.py`), those of the
paper's number of steps (`reduced_10m`: 9,990,000 a slot, networks and updates smaller
than the paper's): Goal-Hazard-Point with four hazards, and with eight beside it.

A claim is a list of sentences, each with the test that decides it. It is reproduced if
all of them hold, not if none does, else in part; and not measured where a result that
it needs is missing. The tests were written down before anything with four hazards was
trained for so long; with eight the results were known. They speak of the agents of
five seeds in 200 fresh episodes each:

- *at zero*: none of 1000 episodes violates, which bounds the rate by 0.3 % (95 %).
- *near zero*: at most 5 % violate. *Not at zero*: by the exact one-sided 95 % bound
  more than 0.3 % do.
- *large drop*: at most half of the return with a limit of 0 on the extrinsic cost.
  *bad return*: at most a quarter of it. *satisfying*: at least half.
- *unchanged*: the 95 % bootstrap interval of the difference of the means over the seeds
  includes 0, for the return and for the cost.
- *about 0.5*: the mean cost is within 0.25 and 1.
- *much more* return: 1.5 times as much or more. *Far fewer* violations: at most half.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import compact
from paper import BOTH, CROWDED, FOLDERS, NAMES, RESULTS, WORLD, in_world

SCALE, EPISODES = "reduced_10m", 1000
BOUND = 0.003  # what no violation in 1000 episodes cannot exclude
MEASURED = {True: "yes", False: "no", None: "not measured"}


class Scores(NamedTuple):
    """A design's agents of one algorithm.

    Attributes:
      row: of a result file, see `paper.scores`; None: not measured.
    """

    row: dict[str, Any] | None

    @property
    def is_known(self) -> bool:
        """Whether there are as many episodes as the tests ask for."""
        return self.row is not None and self.row["episodes"] >= EPISODES

    @property
    def rate(self) -> float:
        """Share of violating episodes."""
        assert self.row is not None
        return self.row["violations"] / self.row["episodes"]

    @property
    def ep_return(self) -> float:
        """Mean over the seeds."""
        assert self.row is not None
        return self.row["return"]["mean"]

    @property
    def ep_cost(self) -> float:
        """Mean over the seeds."""
        assert self.row is not None
        return self.row["cost"]["mean"]

    def __str__(self) -> str:
        if self.row is None:
            return "not measured"
        return (
            f"{self.row['violations']} of {self.row['episodes']} violate, cost "
            f"{self.ep_cost:.3f}, return {self.ep_return:.1f}"
        )


Find = Callable[..., Scores]  # (design, algorithm, world=None) -> scores
Test = Callable[[Find], bool | None]


class Sentence(NamedTuple):
    """A part of a claim, and what decides it.

    Attributes:
      words: what the paper says.
      test: finder of scores -> whether it holds; None: not measured.
      shown: (design, algorithm, world) of the scores that are shown beside it.
    """

    words: str
    test: Test
    shown: tuple[tuple[str, str, str | None], ...]


class Claim(NamedTuple):
    """One of the paper's.

    Attributes:
      title: of what.
      sentences: its parts.
    """

    title: str
    sentences: tuple[Sentence, ...]


def lower_bound(violations: int, episodes: int) -> float:
    """One-sided 95 % Clopper-Pearson bound of a rate from below."""
    from scipy.stats import beta

    if violations == 0:
        return 0.0
    return float(beta.ppf(0.05, violations, episodes - violations + 1))


def includes_zero(a: Sequence[float], b: Sequence[float], draws: int = 10_000) -> bool:
    """Whether the bootstrap interval of mean(a) - mean(b) over seeds includes 0."""
    rng = np.random.default_rng(0)
    means = [rng.choice(np.asarray(x), (draws, len(x))).mean(1) for x in (a, b)]
    low, high = np.percentile(means[0] - means[1], [2.5, 97.5])
    return bool(low <= 0 <= high)


def sentence(
    words: str,
    holds: Callable[..., bool],
    *designs: str,
    algorithm: str,
    world: str | None = None,
) -> Sentence:
    """A sentence on one algorithm's agents of some designs, the first of them shown."""

    def test(find: Find) -> bool | None:
        found = [find(design, algorithm, world) for design in designs]
        if not all(scores.is_known for scores in found):
            return None
        return bool(holds(*found))

    return Sentence(
        f"{NAMES[algorithm]} {words}", test, ((designs[0], algorithm, world),)
    )


def is_zero(scores: Scores) -> bool:
    """None of the episodes violates."""
    return scores.rate == 0


def is_near_zero(scores: Scores) -> bool:
    """At most 5 % of them do."""
    return scores.rate <= 0.05


def is_not_zero(scores: Scores) -> bool:
    """More of them do than none in 1000 leaves open."""
    assert scores.row is not None
    return lower_bound(scores.row["violations"], scores.row["episodes"]) > BOUND


def keeps(share: float) -> Callable[[Scores, Scores], bool]:
    """At least a share of the return of other agents."""
    return lambda scores, plain: scores.ep_return >= share * plain.ep_return


def loses(share: float) -> Callable[[Scores, Scores], bool]:
    """At most a share of the return of other agents is left."""
    return lambda scores, plain: scores.ep_return <= share * plain.ep_return


def is_unchanged(scores: Scores, plain: Scores) -> bool:
    """Neither return nor cost differ beyond their interval."""
    assert scores.row is not None
    assert plain.row is not None
    pairs = [(scores.row[key], plain.row[key]) for key in ("return", "cost")]
    return all(includes_zero(a["seeds"], b["seeds"]) for a, b in pairs)


def of_both(words: str, holds: Callable[..., bool], *designs: str) -> list[Sentence]:
    """A sentence on each of the two algorithms."""
    return [sentence(words, holds, *designs, algorithm=name) for name in BOTH]


def falls_to_zero(row: dict[str, Any]) -> tuple[bool, bool]:
    """Of the last 20 epochs: training cost never at zero, extrinsic mostly there."""
    total, extrinsic = (
        np.asarray(row["curves"][name]["mean"][-20:])
        for name in ("ep_total_cost", "ep_cost")
    )
    return bool((total > 0).all()), bool(np.mean(extrinsic == 0) >= 0.5)


def on_curves(words: str, part: int, algorithm: str) -> Sentence:
    """A sentence on the learning curves with the evolved cost."""

    def test(find: Find) -> bool | None:
        scores = find("evolved", algorithm, None)
        return falls_to_zero(scores.row)[part] if scores.row is not None else None

    return Sentence(
        f"{NAMES[algorithm]} {words}", test, (("evolved", algorithm, None),)
    )


PLAIN = "extrinsic"
PILLARS, PUSH = "Goal-Pillar-Point", ("Push-Hazard-Point", "Push-Pillar-Point")
CAR, DOGGO = "Goal-Hazard-Car", "Goal-Hazard-Doggo"
CPO, PPO = "cpo", "ppo_lagrangian"
CLAIMS = (
    Claim(
        "Limits of 0.5 and 0",
        (
            *of_both(
                "with a limit of 0.5: the cost is about 0.5",
                lambda s: 0.25 <= s.ep_cost <= 1.0,
                "limit_0.5",
            ),
            *of_both("with a limit of 0: not at zero", is_not_zero, PLAIN),
        ),
    ),
    Claim(
        "Negative limits",
        (
            sentence("at -0.1: near zero", is_near_zero, "limit_-0.1", algorithm=CPO),
            sentence("at -1: at zero", is_zero, "limit_-1", algorithm=CPO),
            sentence(
                "at -1: a large drop of return",
                loses(0.5),
                "limit_-1",
                PLAIN,
                algorithm=CPO,
            ),
            sentence(
                "at -1: unchanged", is_unchanged, "limit_-1", PLAIN, algorithm=PPO
            ),
        ),
    ),
    Claim(
        "The cost of coming closer",
        (
            sentence("at zero", is_zero, "distance_decrease", algorithm=CPO),
            sentence(
                "with a bad return",
                loses(0.25),
                "distance_decrease",
                PLAIN,
                algorithm=CPO,
            ),
            sentence("near zero", is_near_zero, "distance_decrease", algorithm=PPO),
            sentence(
                "with a satisfying return",
                keeps(0.5),
                "distance_decrease",
                PLAIN,
                algorithm=PPO,
            ),
        ),
    ),
    Claim(
        "The change of distance, and its indicator",
        (
            *of_both("change: not at zero", is_not_zero, "distance_change"),
            sentence(
                "indicator: at zero",
                is_zero,
                "distance_change_indicator",
                algorithm=CPO,
            ),
            sentence(
                "indicator: near zero",
                is_near_zero,
                "distance_change_indicator",
                algorithm=PPO,
            ),
            *of_both(
                "indicator: a bad return",
                loses(0.25),
                "distance_change_indicator",
                PLAIN,
            ),
        ),
    ),
    Claim(
        "The evolution",
        (),  # filled by `evolution_sentences`, from the searches
    ),
    Claim(
        "The found cost in other tasks and constraints",
        tuple(
            each
            for world in (None, PILLARS, *PUSH)
            for name in BOTH
            for each in (
                sentence("at zero", is_zero, "evolved", algorithm=name, world=world),
                sentence(
                    "without it: not at zero",
                    is_not_zero,
                    PLAIN,
                    algorithm=name,
                    world=world,
                ),
            )
        ),
    ),
    Claim(
        "The found cost with other robots",
        (
            *(
                sentence("at zero", is_zero, "evolved", algorithm=name, world=CAR)
                for name in BOTH
            ),
            sentence("at zero", is_zero, "evolved", algorithm=PPO, world=DOGGO),
            sentence(
                "learns nothing",
                lambda s: s.ep_return <= 1.0,
                "evolved",
                algorithm=CPO,
                world=DOGGO,
            ),
        ),
    ),
    Claim(
        "The training cost never comes to zero, the extrinsic one does",
        tuple(
            on_curves(words, part, name)
            for name in BOTH
            for part, words in enumerate(
                ("the training cost: above zero", "the extrinsic cost: at zero")
            )
        ),
    ),
    Claim(
        "Margins",
        (
            *of_both("3x: at zero", is_zero, "margin_3x"),
            *of_both("2x: not at zero", is_not_zero, "margin_2x"),
            *of_both("1x: not at zero", is_not_zero, "margin_1x"),
            *of_both("the found cost: at zero", is_zero, "evolved"),
            *of_both(
                "the found cost: much more return than 3x",
                keeps(1.5),
                "evolved",
                "margin_3x",
            ),
        ),
    ),
    Claim(
        "Without the extrinsic cost",
        (
            *of_both(
                "far fewer violations",
                lambda alone, plain: alone.rate <= plain.rate / 2,
                "evolved_alone",
                PLAIN,
            ),
            *of_both("not at zero", is_not_zero, "evolved_alone"),
        ),
    ),
    Claim("Computing time", ()),  # filled by `time_sentence`
)


def load(file: Path) -> dict[str, Any]:
    """A result, empty where there is none."""
    return json.loads(file.read_text()) if file.exists() else {}


def finder(folder: Path, world: str) -> Find:
    """Of the scores in a folder of results; `world` is where a claim names none."""
    panels: dict[str, dict[str, Any]] = {}
    for file in sorted(folder.glob("*.json")):
        for name, designs in load(file).get("worlds", {}).items():
            panels.setdefault(name, {}).update(designs)

    def find(design: str, algorithm: str, where: str | None = None) -> Scores:
        panel = panels.get(in_world(where, world) if where else world, {})
        trained = panel.get(design)
        return Scores(trained and trained["algorithms"].get(algorithm))

    return find


def evolution_sentences(folder: Path) -> list[tuple[str, bool | None, str]]:
    """What the searches of the paper's rule say, all seeds together."""
    searches = load(folder / "evolution.json").get("searches", ())
    own = [search["cost"] for search in searches if search["rule"] == "paper"]
    words = ("no candidate at zero in the first stage", "more and more later", "falls")
    if not own:
        return [(text, None, "") for text in words]
    zeros = [[sum(cost == 0 for cost in stage) for stage in stages] for stages in own]
    means = [[float(np.mean(stage)) for stage in stages] for stages in own]
    shown = "; ".join(", ".join(map(str, counts)) for counts in zeros)
    falling = "; ".join(", ".join(f"{m:.2f}" for m in each) for each in means)
    return [
        (words[0], all(counts[0] == 0 for counts in zeros), shown),
        (words[1], all(counts[-1] > counts[0] for counts in zeros), shown),
        (words[2], all(each[-1] < each[0] for each in means), falling),
    ]


def time_sentence(results: Path) -> list[tuple[str, bool | None, str]]:
    """The paper's hours of a task beside ours of one agent."""
    result = load(results / "computing_time.json")
    words = "an agent takes no longer than the paper says of its task"
    if not result:
        return [(words, None, "")]
    longest = {w: max(h[PPO], h[CPO]) for w, h in result["hours"].items()}
    holds = all(hours <= result["paper_hours"][w] for w, hours in longest.items())
    cells = [f"{w} {h:.1f} h ({result['paper_hours'][w]})" for w, h in longest.items()]
    return [(words, holds, ", ".join(cells))]


def judged(results: Path, world: str) -> list[dict[str, Any]]:
    """Every claim in one world."""
    folder = results / FOLDERS[world] / SCALE
    find, found = finder(folder, world), []
    for claim in CLAIMS:
        rows = [
            (
                (f"{part.shown[0][2]}: " if part.shown[0][2] else "") + part.words,
                part.test(find),
                str(find(*part.shown[0])),
            )
            for part in claim.sentences
        ]
        if claim.title == "The evolution":
            rows = evolution_sentences(folder)
        if claim.title == "Computing time":
            rows = time_sentence(results)
        sentences = [
            {"words": words, "holds": holds, "measured": shown}
            for words, holds, shown in rows
        ]
        answers = [holds for _, holds, _ in rows]
        found.append(
            {"claim": claim.title, "verdict": verdict(answers), "sentences": sentences}
        )
    return found


def verdict(answers: Sequence[bool | None]) -> str:
    """Of a claim whose sentences hold or not, or are not measured."""
    if None in answers:
        return "not measured"
    if all(answers):
        return "reproduced"
    return "in part" if any(answers) else "not"


def table(result: dict[str, Any]) -> str:
    """claims.md: the verdicts, then the sentences of each claim."""
    worlds = list(result["worlds"])
    lines = [
        "# The paper's eleven claims",
        "",
        "After 9,990,000 steps a slot, networks and updates smaller than the paper's. "
        "What decides each sentence stands at the top of `experiments/claims.py`.",
        "",
        f"| claim | {' | '.join(worlds)} |",
        "|---" * (1 + len(worlds)) + "|",
    ]
    for rows in zip(*result["worlds"].values(), strict=True):
        verdicts = " | ".join(row["verdict"] for row in rows)
        lines.append(f"| {rows[0]['claim']} | {verdicts} |")
    for world in worlds:
        lines += ["", f"## {world}", "", "| claim | the paper | holds | ours |"]
        lines += ["|---|---|---|---|"]
        for row in result["worlds"][world]:
            lines += [
                f"| {row['claim']} | {part['words']} | {MEASURED[part['holds']]} | "
                f"{part['measured']} |"
                for part in row["sentences"]
            ]
    return "\n".join(lines) + "\n"


def main(results: Path = RESULTS) -> None:
    """Write claims.json and claims.md."""
    worlds = {world: judged(results, world) for world in (WORLD, CROWDED)}
    result = {"command": "python experiments/claims.py", "worlds": worlds}
    (results / "claims.json").write_text(compact(result) + "\n")
    (results / "claims.md").write_text(table(result))


if __name__ == "__main__":
    main()
