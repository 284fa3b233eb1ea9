"""The end of a search: finalists judged, the best cost named, the report written."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from autocost_jax import es as es_lib
from autocost_jax.agents.base import Actor, actor
from autocost_jax.arrays import flatten
from autocost_jax.config import SearchConfig
from autocost_jax.es import Fitness
from autocost_jax.evolution import SearchState, best_of, pick_label
from autocost_jax.outcome import (
    BEST,
    conclusion,
    finalist_actors,
    pick,
    reference_places,
    score_agents,
    succeeded,
    summary_rows,
    table_lines,
)
from autocost_jax.policies import EVALUATION, load_policies, policy_name
from autocost_jax.progress import Display, format_seconds
from autocost_jax.records import Key
from autocost_jax.store import RunDir


def finish(
    run: RunDir,
    root: Key,
    state: SearchState,
    display: Display,
    num_episodes: int,
) -> Path:
    """Judge the finalists on fresh layouts, name the best cost, write the report.

    Args:
      run: the run directory.
      root: the root key of the search.
      state: of a search that is over, its learners in this process's memory.
      display: that says so.
      num_episodes: of each agent.

    Returns:
      The path of the report.

    Raises:
      RuntimeError: every candidate of a stage failed.
    """
    from autocost_jax.report import write_report
    from autocost_jax.summary import load_report

    config = run.config
    best_of(config, state.es)  # refuses a failed search
    actors, num_seeds, places, fitness = _contenders(run, state)
    key = jax.random.fold_in(root, EVALUATION)
    what = f"evaluating over {num_episodes} fresh episodes an agent"
    with display.working(what) as tell:
        scores = score_agents(config.train, actors, num_seeds, key, num_episodes, tell)
    chosen = pick(config, scores)
    rows = summary_rows(config, scores, chosen, num_episodes)
    for cost, place in (reference_places(config) | {BEST: chosen}).items():
        for a, name in enumerate(config.algorithms):
            at = place * num_seeds  # the first seed's
            acting = jax.tree.map(lambda leaf, at=at: leaf[at], actors[a])
            run.write_policy(f"{cost}_{name}", flatten(acting))
            recording = scores.recordings[a][place]._asdict()
            run.write_arrays(f"replay_{cost}_{name}", recording)
    best = int(places[chosen])
    card = _card(config, fitness, best, rows)
    run.write_cost({"theta": np.asarray(state.es.archive[best])}, card)
    text = conclusion(rows, config.train.env.num_steps)
    is_success = bool(reference_places(config)) and succeeded(rows)
    summary = {"rows": rows, "succeeded": is_success, "conclusion": text}
    run.write_json("summary", summary)
    report = write_report(load_report(run.path), run.path / "report" / "index.html")
    for line in [
        f"best cost: candidate {card['index'] + 1} of stage {card['stage'] + 1}",
        *table_lines(rows),
        text,
        f"done in {format_seconds(display.elapsed)}; open {report}",
    ]:
        display.say(line)
    return report


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


def _contenders(
    run: RunDir, state: SearchState
) -> tuple[list[Actor], int, np.ndarray, Fitness]:
    """Whose episodes decide, and where their costs stand in the archive.

    Without a stage of finalists it is the agent of the best candidate that its stage
    left, one seed.

    Returns:
      For each algorithm actors [C x S, ...]; S; places of the candidates among the C;
      and what the archive was judged by.
    """
    config = run.config
    fitness, order = es_lib.top(
        state.es,
        max(1, config.num_finalists),
        config.zero_tolerance,
        config.pool_scores,
    )
    if config.num_finalists:
        actors, num_seeds = finalist_actors(config, state.learners)
        return actors, num_seeds, np.asarray(order), fitness
    stage = int(order[0]) // config.population_size
    files = [
        run.path / "policies" / f"{policy_name(stage, name)}.npz"
        for name in config.algorithms
    ]
    loaded = (load_policies(config.train, [file])[1] for file in files)
    return [actor(state) for state in loaded], 1, np.asarray(order), fitness
