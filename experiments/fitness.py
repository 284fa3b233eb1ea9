"""Which fitness tells the truth? Rank correlation of a stage's scores with the truth.

    python experiments/fitness.py run      # trains everything: 4 minutes of an H100
    python experiments/fitness.py collect  # JSON, table

Random costs of the paper's network are trained three times, with other seeds each time:

    truth   from scratch for 2,000,000 steps, 5 seeds, then 200 fresh episodes each
    short   from scratch for 512,000 steps, 5 seeds: what a stage of a search sees
    warm    for 256,000 steps more from one policy an algorithm and seed, trained with
            the extrinsic cost alone in `short`

A rule of a search is a length, a number of seeds, episodes that count, and a way to
judge by both agents. Its fitness is computed from `short` or `warm` and compared with
the truth of the same costs. The extrinsic cost alone and a margin of 3x are trained
beside them as references.
"""

import dataclasses
import itertools
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import REDUCED, Options, compact, run_part

from autocost_jax.agents.base import actor
from autocost_jax.config import EnvConfig, TrainConfig
from autocost_jax.costs import training_cost
from autocost_jax.envs.env import make_env
from autocost_jax.evaluate import evaluate
from autocost_jax.files import flatten
from autocost_jax.population import Population, make_agents, make_population
from autocost_jax.records import Slot
from autocost_jax.runs.directory import run_facts
from autocost_jax.train import EpochState

ALGORITHMS = ("ppo_lagrangian", "cpo")
REFERENCES = ("extrinsic", "extrinsic+safety_margin_3x")
STUDY = Path(__file__).parent / "results" / "fitness" / "fitness.json"
KEPT = ("ep_cost", "ep_return", "violating_worlds", "ep_total_cost")


class Size(NamedTuple):
    """How much is trained.

    Attributes:
      graded: costs of a graded start.
      normal: costs of N(0, 5^2).
      seeds: of each cost and training.
      truth: epochs.
      short: epochs.
      warm: epochs.
      episodes: of the truth's evaluation, a seed.
    """

    graded: int = 40
    normal: int = 6
    seeds: int = 5
    truth: int = 500
    short: int = 128
    warm: int = 64
    episodes: int = 200


SMOKE = Size(graded=2, normal=1, seeds=2, truth=2, short=2, warm=1, episodes=4)


def costs(size: Size) -> np.ndarray:
    """Theta [C, 41] of all costs; the references' are unused zeros, in front.

    They were drawn once, by the graded start of that time (at percentiles from 10 to
    75, loudness from 0.01 to 0.5) and from N(0, 5^2), and stand in the JSON.
    """
    theta = np.asarray(json.loads(STUDY.read_text())["theta"], np.float32)
    graded = len(REFERENCES) + np.arange(size.graded)
    normal = len(REFERENCES) + Size().graded + np.arange(size.normal)
    return theta[[*range(len(REFERENCES)), *graded, *normal]]


def make_slots(theta: np.ndarray, size: Size, first_seed: int) -> tuple[Slot, ...]:
    """Slots [C * S] of each algorithm, cost by cost; a key for each seed."""
    weights = [training_cost(name, theta[0]).weights for name in REFERENCES]
    network = training_cost("extrinsic+intrinsic", theta[0])
    weights += [network.weights] * (len(theta) - len(REFERENCES))
    num = len(theta) * size.seeds

    def each(rows: Any) -> jax.Array:
        return jnp.repeat(jnp.asarray(np.stack(rows)), size.seeds, axis=0)

    cost = network.replace(
        weights=each(weights), theta=each(theta), limit=jnp.zeros(num)
    )
    groups = []
    for index in range(len(ALGORITHMS)):
        root = jax.random.key(index)
        keys = [jax.random.fold_in(root, first_seed + s) for s in range(size.seeds)]
        keys = jnp.tile(jnp.stack(keys), len(theta))
        groups.append(Slot(cost=cost, key=keys, constrained=jnp.ones(num)))
    return tuple(groups)


def train(
    population: Population,
    state: EpochState,
    slots: Any,
    epochs: int,
    what: str,
) -> tuple[EpochState, dict[str, np.ndarray]]:
    """The state after so many epochs, and `KEPT` metrics [E, A, C * S]."""
    rows, start = [], time.monotonic()
    for epoch in range(epochs):
        state, metrics = population.chunk(state, slots, epoch)
        rows.append([{name: group[name][0] for name in KEPT} for group in metrics])
        jax.block_until_ready(metrics)
        if epoch % 16 == 0:
            print(f"{what} {epoch}: {time.monotonic() - start:.0f} s", flush=True)
    rows = jax.device_get(rows)
    kept = {name: np.asarray([[g[name] for g in r] for r in rows]) for name in KEPT}
    return state, kept


def warm_start(
    population: Population, trained: EpochState, slots: Any, size: Size
) -> EpochState:
    """Fresh learners with the networks of the extrinsic cost's agents, by seed."""
    fresh = population.init(slots)
    groups = []
    for new, old in zip(fresh.learners, trained.learners, strict=True):
        index = np.tile(np.arange(size.seeds), new.frozen.shape[0] // size.seeds)
        taken = jax.tree.map(lambda leaf, index=index: leaf[index], old.agent)
        agent = new.agent.replace(
            policy=taken.policy, critic=taken.critic, normalizer=taken.normalizer
        )
        groups.append(new.replace(agent=agent))
    return EpochState(tuple(groups))


def run(options: Options) -> None:
    """All three trainings and the evaluation, into one npz."""
    path, size = options.runs, SMOKE if options.smoke else Size()
    path.mkdir(parents=True, exist_ok=True)
    config = TrainConfig(
        env=EnvConfig(physics="closed_form", num_steps=100 if options.smoke else 1000),
        agent=dataclasses.replace(REDUCED, normalize_obs=True),
        num_worlds=4,
        num_epochs=1,
    )
    env = make_env(config.env)
    agents = make_agents(ALGORITHMS, config, env)
    population = make_population(env, agents, config, devices=jax.devices())
    theta = costs(size)
    arrays: dict[str, Any] = {"theta": theta}

    def keep(name: str, metrics: dict[str, np.ndarray]) -> None:
        for key, value in metrics.items():
            shape = (*value.shape[:2], len(theta), size.seeds)
            arrays[f"{name}/{key}"] = value.reshape(shape).astype(np.float32)
        np.savez_compressed(path / "fitness.npz", **arrays)

    slots = make_slots(theta, size, 100)
    state, metrics = train(
        population, population.init(slots), slots, size.short, "short"
    )
    keep("short", metrics)
    slots = make_slots(theta, size, 200)
    state = warm_start(population, state, slots, size)
    state, metrics = train(population, state, slots, size.warm, "warm")
    keep("warm", metrics)
    slots = make_slots(theta, size, 0)
    state, metrics = train(
        population, population.init(slots), slots, size.truth, "truth"
    )
    keep("truth", metrics)
    print("evaluating", flush=True)

    score = jax.jit(
        jax.vmap(
            lambda state, key: evaluate(env, agents[0], state, key, size.episodes),
            in_axes=(0, None),
        )
    )
    template = agents[0].init(jax.random.key(0))
    results, policies = [], {}
    for name, group in zip(ALGORITHMS, state.learners, strict=True):
        acting = actor(jax.device_get(group.agent))
        count = len(theta) * size.seeds
        agent = jax.tree.map(
            lambda x, n=count: jnp.broadcast_to(x, (n, *x.shape)), template
        )
        results.append(score(agent.replace(**acting._asdict()), jax.random.key(99)))
        first = jax.tree.map(lambda x: x[:: size.seeds], acting)
        policies |= {f"{name}/{key}": x for key, x in flatten(first).items()}
    for field in ("ep_return", "ep_cost"):
        value = np.stack([np.asarray(getattr(r, field)) for r in results])
        shape = (len(ALGORITHMS), len(theta), size.seeds, size.episodes)
        arrays[f"evaluation/{field}"] = value.reshape(shape)
    np.savez_compressed(path / "fitness.npz", **arrays)
    np.savez_compressed(path / "policies.npz", **policies)
    facts = {"size": size._asdict(), "facts": run_facts()}
    (path / "facts.json").write_text(json.dumps(facts, indent=1, default=str))


class Rule(NamedTuple):
    """How a stage could judge: what it trains, for how long, with how many seeds.

    Attributes:
      training: "short" (from scratch) or "warm".
      epochs: of 4000 steps; the last quarter counts, 16 at most.
      seeds: of each candidate.
    """

    training: str
    epochs: int
    seeds: int

    @property
    def budget(self) -> int:
        """Env steps of a candidate and algorithm."""
        return 4000 * self.epochs * self.seeds


KEYS = {"cost": "ep_cost", "violations": "violating_worlds", "return": "ep_return"}
RULES = [
    *(Rule("short", e, s) for e in (16, 32, 48, 64, 96, 128) for s in (1, 2, 3, 5)),
    *(Rule("warm", e, s) for e in (16, 32, 48, 64) for s in (1, 2, 3, 5)),
]
CPU_STEPS_A_MINUTE = 45_000 * 60  # of this learner on two cores


def judged(arrays: Any, rule: Rule, seeds: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Cost, return and violating episodes [A, C], as a rule would see them."""
    count = min(16, rule.epochs // 4)
    last = slice(rule.epochs - count, rule.epochs)
    return {
        name: arrays[f"{rule.training}/{key}"][last].mean(0)[..., seeds].mean(-1)
        for name, key in KEYS.items()
    }


def spearman(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rank correlation of each row of [..., C] arrays."""
    from scipy.stats import rankdata

    ranks = [rankdata(x, axis=-1) for x in (a, b)]
    ranks = [x - x.mean(-1, keepdims=True) for x in ranks]
    norms = [np.sqrt((x**2).sum(-1)) for x in ranks]
    return (ranks[0] * ranks[1]).sum(-1) / (norms[0] * norms[1])


def correlations(arrays: Any, rule: Rule, graded: np.ndarray) -> dict[str, Any]:
    """Spearman between a rule's scores and the truth, means over choices of seeds.

    Intervals are of the graded costs drawn again 1000 times.
    """
    rng = np.random.default_rng(0)
    draws = np.stack([graded, *rng.choice(graded, (1000, len(graded)))])
    scores = [
        judged(arrays, rule, seeds)
        for seeds in itertools.combinations(range(5), rule.seeds)
    ]
    cost, ep_return = arrays["evaluation/ep_cost"], arrays["evaluation/ep_return"]
    truth = {
        "cost": cost.mean((2, 3)),
        "violations": (cost > 0).mean((2, 3)),
        "return": ep_return.mean((2, 3)),
    }

    def interval(name: str) -> dict[str, float]:
        """Of the means over both agents."""
        true = truth[name].mean(0)[draws]
        each = [spearman(score[name].mean(0)[draws], true) for score in scores]
        values = np.mean(each, axis=0)
        low, high = np.nanpercentile(values[1:], [2.5, 97.5])
        return {"mean": float(values[0]), "low": float(low), "high": float(high)}

    return {
        **rule._asdict(),
        "budget": rule.budget,
        "cpu_minutes_for_ten": 2 * 10 * rule.budget / CPU_STEPS_A_MINUTE,
        **{name: interval(name) for name in truth},
    }


def collect(options: Options) -> None:
    """JSON and table: rank correlation of every rule with the truth."""
    path, results = options.runs, options.results
    with np.load(path / "fitness.npz") as file:
        arrays = {name: file[name] for name in file.files}
    size = Size()
    graded = np.arange(len(REFERENCES), len(REFERENCES) + size.graded)
    rows = [correlations(arrays, rule, graded) for rule in RULES]
    evaluation = {
        name: arrays[f"evaluation/{name}"] for name in ("ep_return", "ep_cost")
    }
    truth = {
        "return": evaluation["ep_return"].mean((2, 3)).round(3).tolist(),
        "ep_cost": evaluation["ep_cost"].mean((2, 3)).round(4).tolist(),
        "violation_rate": (evaluation["ep_cost"] > 0).mean((2, 3)).round(4).tolist(),
    }
    result = {
        "command": "python experiments/fitness.py run && "
        "python experiments/fitness.py collect",
        **json.loads((path / "facts.json").read_text()),
        "costs": [*REFERENCES, *["graded"] * size.graded, *["normal"] * size.normal],
        "theta": arrays["theta"].round(5).tolist(),
        "truth": truth,
        "rules": rows,
    }
    results.mkdir(parents=True, exist_ok=True)
    (results / "fitness.json").write_text(compact(result) + "\n")
    (results / "fitness.md").write_text(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """One line a rule."""
    lines = [
        "| training | epochs | seeds | CPU minutes for 10 candidates | cost (95 %) | "
        "violating episodes | return |",
        "|---" * 7 + "|",
    ]
    for row in rows:
        cells = [
            f"{row[name]['mean']:.2f} ({row[name]['low']:.2f} to "
            f"{row[name]['high']:.2f})"
            for name in KEYS
        ]
        head = f"| {row['training']} | {row['epochs']} | {row['seeds']} | "
        minutes = f"{row['cpu_minutes_for_ten']:.1f}"
        lines.append(f"{head}{minutes} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    run_part("fitness", __doc__, {"run": run, "collect": collect}, ())
