"""The evolution on Goal-Hazard-Point: the paper's rule, and a guided search beside it.

    python experiments/searches.py run       # searches: rules x seeds, one at a time
    python experiments/searches.py validate  # their best costs, rounds of fresh seeds
    python experiments/searches.py ship      # the winner into the package, with a card
    python experiments/searches.py collect   # JSON, table, pictures of what has run

All rules have the same budget and learners, and meet the same layouts. "paper" starts
from N(0, 5^2) and selects and mutates as the paper does. "guided" starts from costs
that rise as anything comes nearer (`es.monotone_start`, std 8), ranks candidates whose
return is below a floor behind all others (`es.rank`), and lets no mutation change how
loud a cost is at a typical place (`es.keep_level`). "raw" is guided with the paper's
mutations. "nearest" trains costs that see only how near the closest object is, of a set
loudness (`es.graded_start`), and judges them by the worse of their two agents, not by
the mean: on a CPU one stage, four times as long as those of the others, so no
evolution; on a GPU two of nearly the paper's length. Sizes, seeds and rounds are in
`PLANS`; `--scale reduced_10m` wants a GPU, `--smoke` is for tests.

What looks best in a search is partly lucky, so the best of all searches go through
rounds of agents with fresh seeds: many of them briefly, the best of these for longer.
"""

import argparse
import dataclasses
import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import paper
import searches_tables
from common import run_if_needed

from autocost_jax import (
    SearchConfig,
    intrinsic_cost,
    load_cost,
    make_env,
    save_cost,
)
from autocost_jax.arrays import load_arrays
from autocost_jax.es import Fitness, rank
from autocost_jax.methods import Method, TableConfig
from autocost_jax.rundata import to_json
from autocost_jax.store import list_stages, read_config, run_facts

# What stands for the costs and for the returns of both algorithms.
JUDGES: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "mean": (np.mean, np.mean),
    "worst": (np.max, np.min),
}
BEST, NEAR = "ic4srl", "ic4srl_nearest"
SHIPPED = Path("src/autocost_jax/found")
DISTANCES = (0.0, 0.3, 0.45, 0.6, 0.75, 0.9, 4.0)  # metres
LOUDNESS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # a step, within 1.5 R of a hazard


class Round(NamedTuple):
    """Fresh agents for the best costs so far.

    Attributes:
      name: of its run directory.
      entrants: how many costs take part, the best of the round before.
      scale: of the training.
      seeds: of the agents, one slot each.
      episodes: fresh ones that an agent is scored in.
      rules: whose costs take part; the round before decides which if it has the same.
      judge: of `JUDGES`, by which the costs are ranked.
      floor: return that a cost must reach there.
      winner: what the best is called in the package; "" if another round decides.
    """

    name: str
    entrants: int
    scale: str
    seeds: tuple[int, ...]
    episodes: int
    rules: tuple[str, ...]
    judge: str
    floor: float
    winner: str = ""


class Plan(NamedTuple):
    """The searches of a scale.

    Attributes:
      size: flags that all of them share.
      rules: flags and seeds of each rule.
      rounds: what decides about the best of them.
      size_text: for the picture.
    """

    size: tuple[str, ...]
    rules: dict[str, tuple[tuple[str, ...], tuple[int, ...]]]
    rounds: tuple[Round, ...]
    size_text: str

    @property
    def floor(self) -> float:
        """Return of both agents from which a candidate counts as useful in tables."""
        return self.rounds[0].floor


def guided(floor: float, *more: str, start: str = "monotone") -> tuple[str, ...]:
    """Flags of a search that wants costs to be useful."""
    first = ("--start", start, "--init-std", "8")
    return (*first, "--return-floor", str(floor), *more)


def nearest(floor: float, *more: str) -> tuple[str, ...]:
    """Flags of a search for costs that see only how near the closest object is."""
    network = ("--network", "nearest", "--judge-by", "worst")
    return guided(floor, *network, *more, start="graded")


FRESH = ((100, 101, 102, 103, 104), 200)  # seeds of a round, and episodes
BRIEF = ((200, 201), 100)
OTHERS = (paper.SEEDS, 200)  # the figures', for what was chosen on fresh ones
DENSE = (("guided", "paper", "raw"), "mean", 2.0)  # who enters a round, how ranked
NEAREST = (("nearest",), "worst", 1.0)
NEAREST_10M = (("nearest",), "worst", 1.5)
GUIDED = (("guided",), "worst", 2.5)
SMALL = ("--preset", "laptop", "--physics", "closed_form", "--population-size", "12")
SMALL += ("--num-elites", "3", "--num-stages", "4", "--num-epochs", "64")
SMALL += ("--chunk-epochs", "4", "--fitness-epochs", "10", "--eval-episodes", "1000")
LARGE = ("--preset", "search", "--physics", "closed_form", "--num-stages", "3")
LARGE += ("--num-epochs", "96", "--chunk-epochs", "8", "--eval-episodes", "1000")
LONGER = ("--num-stages", "1", "--num-epochs", "256", "--fitness-epochs", "40")
LONGEST = ("--num-stages", "2", "--num-epochs", "259", "--chunk-epochs", "37")
LONGEST += ("--fitness-epochs", "20", "--keep-level", "--mutation-std", "0.5")
LONGEST += ("--mutation-low", "0.8", "--mutation-high", "1.25")
PLANS = {
    "reduced": Plan(
        SMALL,
        {
            "guided": (guided(2.0, "--keep-level"), (0, 1, 2)),
            "paper": ((), (0, 1, 2)),
            "raw": (guided(2.0), (0,)),
            "nearest": (nearest(2.0, *LONGER), (0,)),
        },
        (
            Round("shortlist", 16, "reduced", *BRIEF, *DENSE),
            Round("validation", 4, "reduced_2m", *FRESH, *DENSE, paper.EVOLVED),
            Round("nearest_shortlist", 4, "reduced_2m", *BRIEF, *NEAREST),
            Round("nearest_validation", 1, "reduced_2m", *FRESH, *NEAREST, NEAR),
        ),
        "12 candidates; 512,000 steps a slot, 80 episodes a dot and algorithm "
        "(nearest: 2,048,000 and 320)",
    ),
    "reduced_10m": Plan(
        LARGE,
        {
            "guided": (guided(4.0, "--keep-level"), (0,)),
            "nearest": (nearest(1.5, *LONGEST), (0,)),
        },
        (
            Round("validation", 9, "reduced_10m", *FRESH, *GUIDED, "ic4srl_dense"),
            Round("nearest_shortlist", 10, "reduced_8m", *FRESH, *NEAREST_10M),
            Round("nearest_validation", 1, "reduced_10m", *OTHERS, *NEAREST_10M, BEST),
        ),
        "50 candidates; 2,880,000 steps a slot, 300 episodes a dot and algorithm "
        "(nearest: 7,770,000 and 600)",
    ),
}
SMOKE = ("--preset", "smoke", "--physics", "closed_form", "--eval-episodes", "2")
PLANS["smoke"] = PLANS["reduced"]._replace(
    size=SMOKE, rules=PLANS["reduced"].rules | {"nearest": (nearest(2.0), (0,))}
)


def folder(runs: Path, rule: str, seed: int) -> Path:
    """The run directory of a search."""
    return runs / "searches" / f"{rule}_{seed}"


def run(args: argparse.Namespace) -> None:
    """Each search as a user starts it; finished ones are kept, others continued."""
    plan = PLANS[args.scale]
    for rule, (flags, seeds) in plan.rules.items():
        for seed in seeds[:1] if args.smoke else seeds:
            out = folder(args.runs, rule, seed)
            if (out / "report" / "index.html").exists():
                continue
            command = [sys.executable, "-m", "autocost_jax.evolve", "--out", str(out)]
            fresh = (*plan.size, *flags, "--seed", str(seed))
            more = ("--resume",) if (out / "config.yaml").exists() else fresh
            subprocess.run([*command, *more], check=True)


def finished(runs: Path, plan: Plan) -> list[tuple[str, int, Path]]:
    """Rule, seed and directory of each finished search."""
    known = [(rule, s) for rule, (_, seeds) in plan.rules.items() for s in seeds]
    paths = [(rule, seed, folder(runs, rule, seed)) for rule, seed in known]
    return [row for row in paths if (row[2] / "cost.json").exists()]


def entered(runs: Path, plan: Plan, part: Round) -> list[tuple[str, int, Path]]:
    """Those of them whose costs take part in a round."""
    return [row for row in finished(runs, plan) if row[0] in part.rules]


def candidates(runs: Path, plan: Plan, part: Round) -> list[dict[str, Any]]:
    """What the searches of a round have found, best first, ranked as one population.

    The guided search's order: useful ones first, of them the safest. An elite that was
    trained again counts once, with the mean of its scores, so that one lucky stage
    does not carry it.
    """
    of_costs, of_returns = JUDGES[part.judge]
    found: dict[bytes, list[dict[str, Any]]] = {}
    for rule, seed, path in entered(runs, plan, part):
        for stage, file in list_stages(path).items():
            arrays = load_arrays(file)
            costs = of_costs(arrays["scores/ep_cost"], 0)
            returns = of_returns(arrays["scores/ep_return"], 0)
            for index, theta in enumerate(arrays["theta"]):
                row = {"rule": rule, "seed": seed, "stage": stage, "index": index}
                row |= {"theta": theta, "cost": float(costs[index])}
                row["ep_return"] = float(returns[index])
                found.setdefault(theta.tobytes(), []).append(row)
    rows = [
        group[0]
        | {
            "times_trained": len(group),
            "cost": float(np.mean([row["cost"] for row in group])),
            "ep_return": float(np.mean([row["ep_return"] for row in group])),
        }
        for group in found.values()
    ]
    costs, returns = ([row[key] for row in rows] for key in ("cost", "ep_return"))
    return [rows[i] for i in guided_order(costs, returns, part.floor)]


def guided_order(
    costs: Sequence[float], returns: Sequence[float], floor: float
) -> list[int]:
    """Indices, best first, as the guided search ranks."""
    fitness = Fitness(jnp.asarray(costs), jnp.asarray(returns))
    return [int(i) for i in rank(fitness, return_floor=floor)]


def validate(args: argparse.Namespace) -> None:
    """All rounds that have entrants, one after the other."""
    plan = PLANS[args.scale]
    for index, part in enumerate(plan.rounds):
        rows = entrants(args.runs, plan, index)
        if not rows:
            print(f"{part.name}: no finished search by {' or '.join(part.rules)}")
            continue
        scale = paper.scales()["smoke" if args.smoke else part.scale]
        config = paper.table(paper.TRAINING_WORLD, ["extrinsic"], scale)
        methods = tuple(
            Method(f"{i}-{algorithm}", algorithm, paper.WITH_NETWORK, 0.0, theta)
            for i, row in enumerate(rows)
            for algorithm in paper.BOTH
            for theta in [tuple(row["theta"].tolist())]
        )
        seeds = scale.seeds if args.smoke else part.seeds
        config = dataclasses.replace(config, methods=methods, seeds=seeds)
        episodes = scale.episodes if args.smoke else part.episodes
        run_if_needed(config, args.runs / part.name, episodes)


def was_run(runs: Path, part: Round) -> bool:
    """Whether a round is finished."""
    return (runs / part.name / "evaluation.json").exists()


def entrants(runs: Path, plan: Plan, index: int) -> list[dict[str, Any]]:
    """Who takes part in a round: the best of the round before, or of the searches."""
    part, before = plan.rounds[index], plan.rounds[index - 1]
    if index == 0 or before.rules != part.rules:
        ranked = candidates(runs, plan, part)
    else:
        ranked = scored(runs, plan, index - 1) if was_run(runs, before) else []
    return ranked[: part.entrants]


def scored(runs: Path, plan: Plan, index: int) -> list[dict[str, Any]]:
    """The entrants of a round that was run with their scores in it, best first.

    Both algorithms together as `Round.judge` says, ranked as the guided search ranks.
    """
    part = plan.rounds[index]
    name = part.name
    path = runs / name
    config = read_config(path, TableConfig)[0]
    rows = json.loads((path / "evaluation.json").read_text())["rows"]
    result = []
    for i, row in enumerate(entrants(runs, plan, index)):
        theta = np.asarray(config.methods[2 * i].theta, np.float32)
        if not np.array_equal(theta, row["theta"]):
            raise SystemExit(f"{path} was made with other searches: remove it")
        scores = {
            algorithm: paper.summarise(
                [r for r in rows if r["method"] == f"{i}-{algorithm}"]
            )
            for algorithm in paper.BOTH
        }
        result.append(row | {name: scores})

    def judged(key: str, judge: Callable[..., Any]) -> list[float]:
        scores = [row[name].values() for row in result]
        return [float(judge([s[key]["mean"] for s in row])) for row in scores]

    of_costs, of_returns = JUDGES[part.judge]
    costs, returns = judged("cost", of_costs), judged("return", of_returns)
    return [result[i] for i in guided_order(costs, returns, part.floor)]


def ship(args: argparse.Namespace) -> None:
    """Write winners and up to three runners-up, and the winners into the package."""
    plan, where = PLANS[args.scale], args.results / "costs"
    where.mkdir(parents=True, exist_ok=True)
    for index, part in enumerate(plan.rounds):
        if not part.winner or not was_run(args.runs, part):
            continue
        for place, (row, own) in enumerate(placed(args.runs, plan, index)):
            config, facts = read_config(folder(args.runs, row["rule"], row["seed"]))
            name = f"{part.winner}_runner_up_{place}" if place else part.winner
            card = make_card(row, own, config) | {"commit": facts["commit"]}
            save_cost(where / name, row["theta"], to_json(card))
            if place == 0 and not args.smoke:
                SHIPPED.mkdir(exist_ok=True)
                save_cost(SHIPPED / name, row["theta"], to_json(card))
            print(name, card["found"], json.dumps(card["validation"]))


def placed(runs: Path, plan: Plan, index: int) -> list[tuple[dict[str, Any], Round]]:
    """The four best of a round, with the round that scored them.

    Those who did not get as far follow as they were placed in the round before.
    """
    part, before = plan.rounds[index], plan.rounds[index - 1]
    rows = [(row, part) for row in scored(runs, plan, index)]
    if index and before.rules == part.rules:
        left = scored(runs, plan, index - 1)[part.entrants :]
        rows += [(row, before) for row in left]
    return rows[:4]


def make_card(row: dict[str, Any], part: Round, config: SearchConfig) -> dict[str, Any]:
    """How a cost was found, its scores on fresh seeds, and where it fails."""
    validation = {
        algorithm: {
            key: value
            for key, value in score.items()
            if key in ("return", "cost", "episodes") or key.startswith("violation")
        }
        for algorithm, score in row[part.name].items()
    }
    steps = paper.steps_a_slot(paper.scales()[part.scale].train)
    chosen = "it was not chosen by these"
    if part.entrants > 1:
        chosen = f"it was chosen among {part.entrants} on these, so they flatter it"
    violates = [paper.NAMES[a] for a, s in validation.items() if s["violations"]]
    return {
        "found": f"{row['rule']} search, seed {row['seed']}, stage {row['stage'] + 1}, "
        f"candidate {row['index']}",
        "environment": config.train.env.name,
        "budget": f"{config.env_steps:,} env steps a search, reduced scale",
        "judged_by": f"the {part.judge} of the two algorithms; a return of at least "
        f"{part.floor:g}, then the cost",
        "search": {key: row[key] for key in ("cost", "ep_return", "times_trained")},
        "validation": validation,
        "validated_on": f"training seeds {part.seeds}, {steps:,} steps each; {chosen}",
        "fails": f"not free of violations under {' and '.join(violates)}"
        if violates
        else "no violation seen in validation; see the rates' upper bounds",
    }


def collect(args: argparse.Namespace) -> None:
    """JSON, table, the evolution's picture, and the heat map of the winner."""
    plan, searches = PLANS[args.scale], []
    for rule, seed, path in finished(args.runs, plan):
        stages = [load_arrays(file) for file in list_stages(path).values()]
        facts = read_config(path)[1]
        searches.append(
            {
                "rule": rule,
                "seed": seed,
                **{name: facts[name] for name in ("commit", "created", "device")},
                **{name: [r.tolist() for r in rows] for name, rows in both(stages)},
                "best": json.loads((path / "cost.json").read_text()),
            }
        )
    facts = run_facts()
    facts.pop("seed")
    result: dict[str, Any] = {
        "title": "Evolution on Goal-Hazard-Point",
        "paper": "The population's mean cost falls, the best candidates' most; none is "
        "at zero in stage 1, more and more later.",
        "scale": args.scale,
        "command": f"python experiments/searches.py run --scale {args.scale}",
        "facts": facts,
        "searches": searches,
        "size": plan.size_text,
        "floor": plan.floor,
        "loudness": by_loudness(args.runs, plan),
        "distance": {file.name: by_distance(file) for file in winners(args)},
        "rounds": [part.name for part in plan.rounds if was_run(args.runs, part)],
    }
    for index, part in enumerate(plan.rounds):
        if was_run(args.runs, part):
            result[part.name] = [
                {key: value for key, value in row.items() if key != "theta"}
                for row in scored(args.runs, plan, index)
            ]
    result = json.loads(json.dumps(to_json(result), allow_nan=False))
    file = paper.write(result, "evolution", args.results)
    file.with_suffix(".md").write_text(searches_tables.render(result))
    searches_tables.draw(result, file.with_suffix(".png"))
    draw_heat_maps(args)
    print(file)


def both(stages: Sequence[dict[str, Any]]) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Cost and return of each stage's candidates, by mean and by the worse agent."""
    for prefix, judge in (("", "mean"), ("worst_", "worst")):
        of_costs, of_returns = JUDGES[judge]
        costs = [of_costs(stage["scores/ep_cost"], 0) for stage in stages]
        returns = [of_returns(stage["scores/ep_return"], 0) for stage in stages]
        yield f"{prefix}cost", [row.round(4) for row in costs]
        yield f"{prefix}return", [row.round(4) for row in returns]


def by_loudness(runs: Path, plan: Plan) -> dict[str, list[dict[str, Any]]]:
    """Mean fitness of all that was trained, by the cost of a step near a hazard.

    That of the states which the candidate's own agents have visited; the rules of a
    round together.
    """
    tables = {
        ", ".join(part.rules): [
            load_arrays(file)
            for _, _, path in entered(runs, plan, part)
            for file in list_stages(path).values()
        ]
        for part in plan.rounds
    }
    return {rules: binned(table) for rules, table in tables.items() if table}


def binned(tables: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean fitness by `LOUDNESS` of the candidates of some stages."""
    cost, gain, near = (
        np.concatenate(
            [np.atleast_2d(table[f"scores/{name}"]).mean(0) for table in tables]
        )
        for name in ("ep_cost", "ep_return", "intrinsic_near")
    )
    rows = []
    for low, high in itertools.pairwise(LOUDNESS):
        own = (near >= low) & (near < high)
        if own.any():
            row = {"low": low, "high": high, "count": int(own.sum())}
            rows.append(row | {"cost": cost[own].mean(), "return": gain[own].mean()})
    return rows


def winners(args: argparse.Namespace) -> list[Path]:
    """The files of the shipped costs, without their suffix."""
    names = [part.winner for part in PLANS[args.scale].rounds if part.winner]
    files = [args.results / "costs" / name for name in names]
    return [file for file in files if file.with_suffix(".npz").exists()]


def by_distance(file: Path, num_places: int = 8192) -> list[dict[str, Any]]:
    """A cost at random places of its world, by the distance to the closest hazard."""
    env = make_env(paper.TRAINING_WORLD)
    keys = jax.random.split(jax.random.key(0), num_places)
    layout = jax.jit(jax.vmap(env.reset))(keys).layout
    xy = jax.random.uniform(jax.random.key(1), (num_places, 2), minval=-2.0, maxval=2.0)
    yaw = jax.random.uniform(jax.random.key(2), (num_places,), maxval=2 * np.pi)
    layout = layout.replace(robot_xy=xy, robot_yaw=yaw)
    inputs = jax.jit(jax.vmap(env.reset_to))(layout, keys).cost_inputs
    cost = np.asarray(intrinsic_cost(load_cost(file), inputs.constraint_lidar))
    distance = np.asarray(inputs.distance)
    rows = []
    for low, high in itertools.pairwise(DISTANCES):
        own = cost[(distance >= low) & (distance < high)]
        row = {"low": low, "high": high, "mean": own.mean()}
        rows.append(row | {f"p{p}": np.percentile(own, p) for p in (10, 90)})
    return rows


def draw_heat_maps(args: argparse.Namespace) -> None:
    """The shipped costs around one hazard, as in the paper."""
    from autocost_jax.report_assets.figures import heat_map

    for file in winners(args):
        picture = heat_map(np.asarray(load_cost(file)), radius=0.3)
        picture.savefig(args.results / f"heat_map_{file.name}.png", dpi=130)


PARTS = {"run": run, "validate": validate, "ship": ship, "collect": collect}

if __name__ == "__main__":
    options = paper.arguments(
        paper.parser(__doc__, PARTS, scales=("reduced", "reduced_10m"))
    )
    PARTS[options.part](options)
