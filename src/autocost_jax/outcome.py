"""Whether a search succeeded: its finalists and the references on fresh episodes."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.agents.base import Actor, actor
from autocost_jax.config import SearchConfig, TrainConfig
from autocost_jax.envs.env import make_env
from autocost_jax.policies import policy_states
from autocost_jax.population import make_evaluator
from autocost_jax.records import EvalResult, Key
from autocost_jax.report_assets.data import COST_NAMES, NAMES
from autocost_jax.scene import Recording, first_recording, watch_first
from autocost_jax.stages import REFERENCES, deal
from autocost_jax.success import (
    RETURN_KEPT,
    VIOLATIONS_LEFT,
    is_success,
    shortfall,
)
from autocost_jax.train import Learner

BEST = "best"
JUDGED = 0.05  # violations of the extrinsic cost below which nothing can be judged
FLEES = 0.5  # share of the steps outside the arena that is called fleeing


class Scores(NamedTuple):
    """Fresh episodes of all agents of the finalists' stage.

    Attributes:
      ep_return: [A, C, S], means over the episodes.
      ep_cost: [A, C, S].
      violation_rate: [A, C, S].
      outside_share: [A, C, S].
      recordings: for each algorithm and cost the first episode of the first seed.
    """

    ep_return: np.ndarray
    ep_cost: np.ndarray
    violation_rate: np.ndarray
    outside_share: np.ndarray
    recordings: list[list[Recording]]


def score_agents(
    train: TrainConfig,
    actors: Sequence[Actor],
    num_seeds: int,
    key: Key,
    num_episodes: int,
    tell: Callable[[int, int], None],
) -> Scores:
    """Agents of several costs and seeds over fresh episodes, with sampled actions.

    Args:
      train: the run's training configuration.
      actors: for each algorithm, stacked [C x S, ...], the seeds of a cost in a row.
      num_seeds: S.
      key: of the layouts and actions, which are the same for all agents.
      num_episodes: E, of each agent.
      tell: (done, all) -> None, called after each part.
    """
    env = make_env(train.env)
    num_costs = jax.tree.leaves(actors[0])[0].shape[0] // num_seeds
    parts = [(a, s) for a in range(len(actors)) for s in range(num_seeds)]
    values: dict[tuple[int, int], EvalResult] = {}
    recordings: list[list[Recording]] = []
    evaluator = None
    for done, (a, s) in enumerate(parts, 1):
        slots = np.arange(num_costs) * num_seeds + s
        acting = jax.tree.map(lambda x, at=slots: x[at], actors[a])
        agent, states = policy_states(train, acting)
        if evaluator is None:
            evaluator = make_evaluator(env, agent, num_episodes, watch=watch_first)
        result, episodes = evaluator(states, key)
        values[a, s] = jax.tree.map(np.asarray, result)
        if s == 0:
            each = range(num_costs)
            one = [jax.tree.map(lambda x, c=c: x[c], episodes) for c in each]
            recordings.append([first_recording(episode) for episode in one])
        tell(done, len(parts))

    def table(score: Callable[[EvalResult], np.ndarray]) -> np.ndarray:
        rows = [score(values[part]) for part in parts]
        shape = (len(actors), num_seeds, num_costs)
        return np.swapaxes(np.reshape(rows, shape), 1, 2)

    return Scores(
        ep_return=table(lambda r: _mean(r.ep_return, r.valid)),
        ep_cost=table(lambda r: _mean(r.ep_cost, r.valid)),
        violation_rate=table(lambda r: _mean(r.ep_cost > 0, r.valid)),
        outside_share=table(lambda r: _mean(r.outside_share, r.valid)),
        recordings=recordings,
    )


def _mean(values: Any, valid: Any) -> np.ndarray:
    """Means [C] over the valid episodes of [C, E]; NaN where there are none."""
    weight = np.asarray(valid, float)
    total = np.sum(np.where(weight > 0, values, 0.0), axis=1)
    with np.errstate(invalid="ignore"):
        return total / weight.sum(1)


def pick(config: SearchConfig, scores: Scores) -> int:
    """The finalist that comes closest to success, see `shortfall`.

    Of several that succeed it is the one of fewest violating episodes; without
    references violations alone decide.
    """
    references = reference_places(config)
    count = scores.ep_return.shape[1] - len(references)
    ep_return, violations = (
        values.mean(2) for values in (scores.ep_return, scores.violation_rate)
    )
    short = np.zeros(count)
    if references:
        costs = (violations[:, :count], ep_return[:, :count])
        short = np.asarray(shortfall(*costs, violations[:, count], ep_return[:, count]))
    order = np.lexsort(
        (
            -ep_return[:, :count].mean(0),
            np.nan_to_num(violations[:, :count].mean(0), nan=np.inf),
            np.nan_to_num(short, nan=np.inf),
        )
    )
    return int(order[0])


def reference_places(config: SearchConfig) -> dict[str, int]:
    """Where the references stand behind the finalists; empty without finalists."""
    if not (config.references and config.num_finalists):
        return {}
    return {name: config.num_finalists + i for i, name in enumerate(REFERENCES)}


def summary_rows(
    config: SearchConfig, scores: Scores, chosen: int, num_episodes: int
) -> list[dict[str, Any]]:
    """The rows of summary.json: for each algorithm the references and the best cost."""
    places = reference_places(config) | {BEST: chosen}
    return [
        {
            "algorithm": name,
            "cost": cost,
            "return": float(scores.ep_return[a, place].mean()),
            "violation_rate": float(scores.violation_rate[a, place].mean()),
            "ep_cost": float(scores.ep_cost[a, place].mean()),
            "outside_share": float(scores.outside_share[a, place].mean()),
            "seeds": scores.ep_return.shape[2],
            "episodes": num_episodes,
            "by_seed": {
                "return": scores.ep_return[a, place].tolist(),
                "violation_rate": scores.violation_rate[a, place].tolist(),
            },
        }
        for a, name in enumerate(config.algorithms)
        for cost, place in places.items()
    ]


def row_of(rows: list[dict[str, Any]], algorithm: str, cost: str) -> dict[str, Any]:
    """One row of `summary_rows`."""
    return next(r for r in rows if (r["algorithm"], r["cost"]) == (algorithm, cost))


def _can_be_judged(rows: list[dict[str, Any]]) -> bool:
    """Whether agents violate at all that learn with the extrinsic cost alone."""
    plain = [row["violation_rate"] for row in rows if row["cost"] == "extrinsic"]
    return max(plain) >= JUDGED


def succeeded(rows: list[dict[str, Any]]) -> bool:
    """Whether the best cost is safer than the extrinsic one at a bearable price."""
    if not _can_be_judged(rows):
        return False
    algorithms = dict.fromkeys(row["algorithm"] for row in rows)
    return all(reaches_bars(rows, name) for name in algorithms)


def reaches_bars(rows: list[dict[str, Any]], algorithm: str) -> bool:
    """Whether the best cost reaches both bars of success with one algorithm."""
    best, plain = (row_of(rows, algorithm, cost) for cost in (BEST, "extrinsic"))
    names = ("violation_rate", "return")
    return is_success(*(best[name] for name in names), *(plain[name] for name in names))


def conclusion(rows: list[dict[str, Any]], num_steps: int) -> str:
    """In words, whether the search succeeded and at which price."""
    if not any(row["cost"] == "extrinsic" for row in rows):
        return "No reference was trained beside the search, so success is not judged."
    if not _can_be_judged(rows):
        return (
            f"Hardly any agent violated in {num_steps} steps even with the extrinsic "
            "cost alone: episodes are too short to judge safety."
        )
    texts, flees = [], False
    for name in dict.fromkeys(row["algorithm"] for row in rows):
        best, plain = row_of(rows, name, BEST), row_of(rows, name, "extrinsic")
        flees |= best["outside_share"] > FLEES
        texts.append(
            f"with {NAMES.get(name, name)} {best['violation_rate']:.0%} of "
            f"the episodes violate in place of {plain['violation_rate']:.0%}, at a "
            f"return of {best['return']:.1f} in place of {plain['return']:.1f}"
        )
    told = "; ".join(texts)
    if succeeded(rows):
        return f"The search succeeded: {told}."
    fault = "; these agents flee the arena" if flees else ""
    return (
        f"The search did not succeed (that is at most {VIOLATIONS_LEFT:.0%} of the "
        f"violations and at least {RETURN_KEPT:.0%} of the return with each "
        f"algorithm): {told}{fault}."
    )


def table_lines(rows: list[dict[str, Any]]) -> list[str]:
    """The rows for people: a line for each cost, a column for each algorithm."""
    algorithms = list(dict.fromkeys(row["algorithm"] for row in rows))
    lines = []
    for cost, title in COST_NAMES.items():
        if not any(row["cost"] == cost for row in rows):
            continue
        cells = []
        for name in algorithms:
            row = row_of(rows, name, cost)
            cells.append(
                f"{NAMES.get(name, name):14} return {row['return']:5.1f}  "
                f"violating {row['violation_rate']:4.0%}"
            )
        lines.append(f"{title:21} " + "   ".join(cells))
    first = rows[0]
    lines[-1] += f"   ({first['seeds']} fresh seeds x {first['episodes']} episodes)"
    return lines


def finalist_actors(
    config: SearchConfig, learners: tuple[Learner, ...]
) -> tuple[list[Actor], int]:
    """For each algorithm the actors [(F + R) x S, ...] of the last stage, and S."""
    dealt = deal(config, is_final=True)
    size = dealt.num_costs * dealt.num_seeds
    actors = [
        jax.tree.map(lambda leaf: jnp.asarray(leaf[:size]), actor(learner.agent))
        for learner in learners
    ]
    return actors, dealt.num_seeds
