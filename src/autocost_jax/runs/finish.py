"""The end of a search: finalists judged, the best cost named."""

from typing import Any

import jax
import numpy as np

from autocost_jax import es as es_lib
from autocost_jax.agents.base import Actor, actor
from autocost_jax.config import SearchConfig
from autocost_jax.envs.env import Env
from autocost_jax.es import Fitness
from autocost_jax.files import flatten
from autocost_jax.population import run_compiled
from autocost_jax.runs.directory import RunDir
from autocost_jax.runs.outcome import (
    BEST,
    compared,
    conclusion,
    final_actors,
    finalist_rows,
    last_scores,
    pick,
    score_agents,
    succeeded,
    summary_rows,
    table_lines,
)
from autocost_jax.runs.policies import EVALUATION, load_policies, policy_name
from autocost_jax.runs.progress import Display
from autocost_jax.search.evolution import Searcher, SearchState, best_of, pick_label


def finish(
    run: RunDir,
    searcher: Searcher,
    state: SearchState,
    display: Display,
    num_episodes: int,
) -> None:
    """Pick the best of the finalists and score it on fresh layouts.

    Args:
      run: the run directory.
      searcher: of the search.
      state: of a search that is over, its training in this process's memory.
      display: that says so.
      num_episodes: of each agent.

    Raises:
      RuntimeError: every candidate of a stage failed.
    """
    config = run.config
    best_of(config, state.es)  # refuses a failed search
    fitness, order = run_compiled(
        es_lib.top,
        state.es,
        num=max(1, config.num_finalists),
        zero_tolerance=config.zero_tolerance,
        pool_scores=config.pool_scores,
    )
    learners = state.training.learners
    chosen, finalists = 0, []
    if config.num_finalists:
        last = last_scores(config, state.history, learners)
        chosen = pick(config, *last)
        finalists = finalist_rows(config, np.asarray(order), *last)
        actors, num_seeds = final_actors(config, learners, chosen)
    best = int(order[chosen])
    if not config.num_finalists:
        actors, num_seeds = _left_by_its_stage(run, searcher.env, best), 1
    key = jax.random.fold_in(searcher.root, EVALUATION)
    what = f"evaluating over {num_episodes} fresh episodes an agent"
    sizes = (num_seeds, key, num_episodes)
    with display.working(what) as tell:
        scores = score_agents(searcher.env, config.train, actors, *sizes, tell)
    rows = summary_rows(config, scores, num_episodes)
    for cost, place in compared(config).items():
        for a, name in enumerate(config.algorithms):
            at = place * num_seeds  # the first seed's
            acting = jax.tree.map(lambda leaf, at=at: leaf[at], actors[a])
            run.write_policy(f"{cost}_{name}", flatten(acting))
            recording = scores.recordings[a][place]._asdict()
            run.write_arrays(f"replay_{cost}_{name}", recording)
    card = _card(config, fitness, best, rows)
    run.write_cost({"theta": np.asarray(state.es.archive[best])}, card)
    text = conclusion(rows, config.train.env.num_steps)
    summary = {
        "rows": rows,
        "succeeded": len(compared(config)) > 1 and succeeded(rows),
        "conclusion": text,
        "finalists": finalists,
    }
    run.write_json("summary", summary)
    for line in [
        f"best cost: candidate {card['index'] + 1} of stage {card['stage'] + 1}",
        *table_lines(rows),
        text,
    ]:
        display.say(line)


def _card(
    config: SearchConfig, fitness: Fitness, place: int, rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """What is known of the best cost, which stands at a place of the archive."""
    stage, index = divmod(place, config.population_size)
    evaluation = {row["algorithm"]: row for row in rows if row["cost"] == BEST}
    is_zero = all(row["violation_rate"] == 0 for row in evaluation.values())
    return {
        "label": pick_label(config, is_zero, config.num_finalists > 0),
        "environment": config.train.env.name,
        "stage": stage,
        "index": index,
        "judged_by": config.judge_by,
        "search_score": float(fitness.cost[place]),
        "search_return": float(fitness.ep_return[place]),
        "env_steps": config.env_steps,
        "seed": config.seed,
        "evaluation": evaluation,
    }


def _left_by_its_stage(run: RunDir, env: Env, place: int) -> list[Actor]:
    """For each algorithm the agent [1, ...] of a candidate that its stage has kept."""
    stage = place // run.config.population_size
    files = [
        run.path / "policies" / f"{policy_name(stage, name)}.npz"
        for name in run.config.algorithms
    ]
    loaded = (load_policies(env, run.config.train, [file])[1] for file in files)
    return [actor(state) for state in loaded]
