"""Whether a search succeeded: its best cost and the references on fresh episodes.

The best is picked among the finalists by the last episodes of their training, so that
the fresh episodes that it is reported on have had no part in the choice.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.agents.base import Actor, actor
from autocost_jax.config import SearchConfig, TrainConfig
from autocost_jax.envs.env import Env
from autocost_jax.evaluate import Recording, first_recording, watch_first
from autocost_jax.population import make_evaluator, run_compiled
from autocost_jax.records import EvalResult, Key, Metrics
from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.runs.policies import policy_states
from autocost_jax.search.stages import REFERENCES, deal
from autocost_jax.search.success import (
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
    """Fresh episodes of the agents of the best cost, then of the references.

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
    env: Env,
    train: TrainConfig,
    actors: Sequence[Actor],
    num_seeds: int,
    key: Key,
    num_episodes: int,
    tell: Callable[[int, int], None],
) -> Scores:
    """Agents of several costs and seeds over fresh episodes, with sampled actions.

    Args:
      env: where they act.
      train: the run's training configuration.
      actors: for each algorithm, stacked [C x S, ...], the seeds of a cost in a row.
      num_seeds: S.
      key: of the layouts and actions, which are the same for all agents.
      num_episodes: E, of each agent.
      tell: (done, all) -> None, called after each part.
    """
    num_costs = jax.tree.leaves(actors[0])[0].shape[0] // num_seeds
    parts = [(a, s) for a in range(len(actors)) for s in range(num_seeds)]
    values: dict[tuple[int, int], EvalResult] = {}
    recordings: list[list[Recording]] = []
    evaluator = None
    for done, (a, s) in enumerate(parts, 1):
        slots = np.arange(num_costs) * num_seeds + s
        acting = jax.tree.map(lambda x, at=slots: x[at], actors[a])
        agent, states = policy_states(env, train, acting)
        if evaluator is None:
            evaluator = make_evaluator(
                env, agent, num_episodes, keep=first_recording, watch=watch_first
            )
        result, kept = evaluator(states, key)
        values[a, s] = jax.tree.map(np.asarray, result)
        if s == 0:
            kept = jax.tree.map(np.asarray, kept)
            each = range(num_costs)
            recordings.append([jax.tree.map(lambda x, c=c: x[c], kept) for c in each])
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


def last_scores(
    config: SearchConfig, history: Metrics, learners: tuple[Learner, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return and share of violating episodes at the end of the finalists' training.

    Args:
      config: the search.
      history: of the finalists' stage, see `SearchState`.
      learners: of that stage.

    Returns:
      Two arrays [A, F + R, S], means over the last `fitness_epochs`; NaN: frozen.
    """
    after = config.epochs_of(config.num_stages)
    dealt = deal(config, is_final=True)

    frozen = dealt.table(np.stack([np.asarray(group.frozen) for group in learners]))

    def table(name: str) -> np.ndarray:
        values = np.asarray(history[name])[after - config.fitness_epochs : after]
        return np.where(frozen, np.nan, dealt.table(values).mean(0))

    return table("ep_return"), table("violating_worlds")


def pick(config: SearchConfig, ep_return: np.ndarray, violations: np.ndarray) -> int:
    """The finalist that comes closest to a search's aims, see `shortfall`.

    Of several that reach them it is the one of fewest violating episodes; without
    references violations alone decide.

    Args:
      config: the search.
      ep_return: [A, F + R, S] of the finalists, then the references.
      violations: [A, F + R, S] share of violating episodes. A finalist with a NaN is
        never picked; of a reference the other seeds count.
    """
    count = config.num_finalists
    both = (violations, ep_return)
    plain = [jnp.nanmean(x[:, count : count + 1], axis=(1, 2)) for x in both]
    violations, ep_return = (x.mean(2) for x in both)
    short = np.zeros(count)
    if config.references:
        costs = (violations[:, :count], ep_return[:, :count])
        short = np.asarray(run_compiled(shortfall, *costs, *plain))
    order = np.lexsort(
        (
            -ep_return[:, :count].mean(0),
            np.nan_to_num(violations[:, :count].mean(0), nan=np.inf),
            np.nan_to_num(short, nan=np.inf),
        )
    )
    return int(order[0])


def finalist_rows(
    config: SearchConfig,
    order: np.ndarray,
    ep_return: np.ndarray,
    violations: np.ndarray,
) -> list[dict[str, Any]]:
    """All finalists for summary.json: where they come from, their last scores.

    Args:
      config: the search.
      order: [F] their places in the archive, best first.
      ep_return: [A, F + R, S] as `last_scores`.
      violations: [A, F + R, S] likewise.
    """
    rows = []
    for i, place in enumerate(order.tolist()):
        stage, index = divmod(place, config.population_size)
        row: dict[str, Any] = {"stage": stage, "index": index}
        for a, name in enumerate(config.algorithms):
            row[name] = {
                "return": ep_return[a, i].tolist(),
                "violation_rate": violations[a, i].tolist(),
            }
        rows.append(row)
    return rows


def compared(config: SearchConfig) -> dict[str, int]:
    """Where the costs of the summary stand in `Scores`: the references, the best."""
    is_compared = config.references and config.num_finalists
    names = REFERENCES if is_compared else ()
    return {name: 1 + i for i, name in enumerate(names)} | {BEST: 0}


def summary_rows(
    config: SearchConfig, scores: Scores, num_episodes: int
) -> list[dict[str, Any]]:
    """The rows of summary.json: for each algorithm the references and the best cost."""
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
        for cost, place in compared(config).items()
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
            f"with {algorithm_label(name)} {best['violation_rate']:.0%} of "
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
    for cost, title in COST_LABELS.items():
        if not any(row["cost"] == cost for row in rows):
            continue
        cells = []
        for name in algorithms:
            row = row_of(rows, name, cost)
            cells.append(
                f"{algorithm_label(name):14} return {row['return']:5.1f}  "
                f"violating {row['violation_rate']:4.0%}"
            )
        lines.append(f"{title:21} " + "   ".join(cells))
    first = rows[0]
    lines[-1] += f"   ({first['seeds']} fresh seeds x {first['episodes']} episodes)"
    return lines


def final_actors(
    config: SearchConfig, learners: tuple[Learner, ...], chosen: int
) -> tuple[list[Actor], int]:
    """For each algorithm the actors [(1 + R) x S, ...] of a finalist and R; and S."""
    dealt = deal(config, is_final=True)
    costs = [chosen, *range(config.num_finalists, dealt.num_costs)]
    slots = np.concatenate([np.flatnonzero(dealt.cost == cost) for cost in costs])
    actors = [
        jax.tree.map(lambda leaf: np.asarray(leaf)[slots], actor(learner.agent))
        for learner in learners
    ]
    return actors, dealt.num_seeds
