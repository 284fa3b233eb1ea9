"""The AutoCost search: ask -> train every candidate -> fitness -> tell, stage by stage.

Two ways to run one and the same search: `evolve`, a host loop over jitted chunks that
can be watched, checkpointed and resumed, and `search`, a pure function of a key. Both
are made of the same pieces.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from autocost_jax import es as es_lib
from autocost_jax.config import SearchConfig
from autocost_jax.costs import BANK, CostTerm
from autocost_jax.envs.env import Env, make_env
from autocost_jax.es import ESState, Fitness
from autocost_jax.population import (
    Population,
    jit_bundle,
    make_agents,
    make_population,
    run_compiled,
)
from autocost_jax.records import Key, Metrics, Slot, root_key
from autocost_jax.search.stages import (
    TRACKED,
    StageFunctions,
    StageResult,
    deal,
    stage_functions,
)
from autocost_jax.train import (
    EpochState,
    Learner,
    final_episodes,
    init_learner,
    run_stage,
)


class SearchState(struct.PyTreeNode):
    """Everything a search needs to go on; a checkpoint holds exactly this.

    Attributes:
      es: the evolutionary strategy's state.
      candidates: [P, D] the candidates in training; in the finalists' stage the best of
        the search, of which the first are trained.
      training: of each algorithm's slots [N], as `stages.deal` has them.
      stage: [] int32; `num_stages` is that of the finalists, and
        `SearchConfig.total_stages` says that the search is over.
      epoch: [] int32, epochs of this stage already done.
      history: `TRACKED` metrics of this stage, each [E, A, N], of E epochs at most.
    """

    es: ESState
    candidates: jax.Array
    training: EpochState
    stage: jax.Array
    epoch: jax.Array
    history: Metrics


class Progress(NamedTuple):
    """What one chunk of `evolve` reports.

    Attributes:
      stage: stage of these epochs.
      epoch: first epoch of the chunk.
      metrics: for each algorithm, NumPy arrays [K, N].
      result: the stage's result if this chunk ended it, else None; the finalists' stage
        has none, its agents are to be judged by fresh episodes.
      learners: with a result the trained agents, for each algorithm stacked [N, ...].
    """

    stage: int
    epoch: int
    metrics: tuple[dict[str, np.ndarray], ...]
    result: StageResult | None = None
    learners: tuple[Learner, ...] = ()


class SearchResult(struct.PyTreeNode):
    """The outcome of the pure `search`.

    Attributes:
      es: the final state of the strategy; `best_of` picks from its archive, and
        raises if all candidates of a stage failed. (`es.best` is then NaN.)
      fitness: fields [S, P], S stages.
      scores: `TRACKED` metrics of each stage, each [S, A, P].
      references: the same of the reference costs, each [S, A, R].
      finalists: [F, D], best first.
      final_scores: `TRACKED` metrics of the finalists, then the references, over the
        last `fitness_epochs` of their stage, each [A, F + R, seeds].
    """

    es: ESState
    fitness: Fitness
    scores: Metrics
    references: Metrics
    finalists: jax.Array
    final_scores: Metrics


class Searcher(NamedTuple):
    """The compiled pieces of a search on given devices.

    Attributes:
      config: the search.
      env: its environment.
      root: its root key.
      population: the population program.
      stage: the functions around it, jitted.
    """

    config: SearchConfig
    env: Env
    root: Key
    population: Population
    stage: StageFunctions


def search(
    config: SearchConfig, bank: Sequence[CostTerm] = BANK
) -> Callable[[Key], SearchResult]:
    """The whole search as one pure function of its root key; jit or vmap it."""
    env = make_env(config.train.env)
    agents = make_agents(config.algorithms, config.train, env)

    def run(root: Key) -> SearchResult:
        functions = stage_functions(config, env, root, bank)

        def train(slots: tuple[Slot, ...], epochs: int) -> tuple[Metrics, jax.Array]:
            """`TRACKED` metrics [E, A, N], and which agents are frozen [A, N]."""
            sizes = dataclasses.replace(config.train, num_epochs=epochs)
            learners = tuple(
                jax.vmap(lambda slot, agent=agent: init_learner(agent, slot))(group)
                for agent, group in zip(agents, slots, strict=True)
            )
            learners, metrics = run_stage(env, agents, sizes, learners, slots, bank)
            if config.final_rounds:
                metrics = final_episodes(
                    env, agents, sizes, learners, slots, config.final_rounds
                )
            return _tracked(metrics), jnp.stack([group.frozen for group in learners])

        def body(state: ESState, stage: jax.Array):
            candidates, slots = functions.begin(state, stage)
            history, frozen = train(slots, config.train.num_epochs)
            state, result = functions.end(state, stage, candidates, history, frozen)
            return state, (result.fitness, result.scores, result.references)

        stages = jnp.arange(config.num_stages)
        state, told = jax.lax.scan(body, functions.init(), stages)
        finalists, final_scores = state.elites[:0], {}
        if config.num_finalists:
            candidates, slots = functions.begin_final(state)
            finalists = candidates[: config.num_finalists]
            history, _ = train(slots, config.epochs_of(config.num_stages))
            dealt = deal(config, is_final=True)
            for name, value in history.items():
                last = dealt.table(value[-config.fitness_epochs :])
                final_scores[name] = jnp.mean(last, axis=0)
        return SearchResult(state, *told, finalists, final_scores)

    return run


def make_searcher(
    config: SearchConfig,
    devices: Sequence[Any] | None = None,
    bank: Sequence[CostTerm] = BANK,
) -> Searcher:
    """Build the program of a search; nothing is compiled yet."""
    env = make_env(config.train.env)
    agents = make_agents(config.algorithms, config.train, env)
    root = root_key(config.seed)
    return Searcher(
        config=config,
        env=env,
        root=root,
        population=make_population(
            env, agents, config.train, bank, devices, config.final_rounds
        ),
        stage=jit_bundle(stage_functions(config, env, root, bank)),
    )


def init_search(searcher: Searcher) -> SearchState:
    """The state before the first epoch of the first stage."""
    return _begin_stage(searcher, searcher.stage.init(), 0)


def evolve(
    config: SearchConfig,
    *,
    state: SearchState | None = None,
    searcher: Searcher | None = None,
) -> Iterator[tuple[SearchState, Progress]]:
    """Run or continue a search, one chunk of epochs at a time.

    Args:
      config: the search.
      state: where to continue; default: from the start. Its training is consumed.
      searcher: from `make_searcher(config, ...)`; default: one device.

    Yields:
      After each chunk the state, ready to be saved and continued from, and what
      happened. A yielded state's training is consumed by the next chunk.

    Raises:
      RuntimeError: after a stage, if all its candidates failed; it names the stage.
        A state in which that has happened raises it again at once.
    """
    searcher = make_searcher(config) if searcher is None else searcher
    state = init_search(searcher) if state is None else state
    require_survivors(config, state.es)
    while int(state.stage) < config.total_stages:
        state, progress = _run_chunk(searcher, state)
        yield state, progress
        if progress.result is not None:
            require_survivors(config, state.es)


def _begin_stage(searcher: Searcher, es_state: ESState, stage: int) -> SearchState:
    config = searcher.config
    if stage < config.num_stages:
        candidates, slots = searcher.stage.begin(es_state, stage)
    else:
        candidates, slots = searcher.stage.begin_final(es_state)
    epochs = max(config.epochs_of(stage) for stage in range(config.total_stages))
    shape = (epochs, len(config.algorithms), config.slots_per_algorithm)
    return SearchState(
        es=es_state,
        candidates=candidates,
        training=searcher.population.init(slots),
        stage=jnp.asarray(stage, jnp.int32),
        epoch=jnp.zeros((), jnp.int32),
        history={name: jnp.zeros(shape, jnp.float32) for name in TRACKED},
    )


def _run_chunk(searcher: Searcher, state: SearchState) -> tuple[SearchState, Progress]:
    """One chunk; at a stage's end also `tell` and the beginning of the next stage."""
    config, functions = searcher.config, searcher.stage
    stage, epoch = int(state.stage), int(state.epoch)
    slots = slots_of(searcher, state)
    training, metrics = searcher.population.chunk(state.training, slots, epoch)
    metrics = searcher.population.fetch(metrics)
    history = functions.record(state.history, metrics, epoch)
    after = epoch + config.train.chunk_epochs
    progress = Progress(stage, epoch, jax.tree.map(np.asarray, metrics))
    state = state.replace(
        training=training, history=history, epoch=jnp.asarray(after, jnp.int32)
    )
    if after < config.epochs_of(stage):
        return state, progress
    if stage == config.num_stages:
        return _ended(searcher, state), progress
    history = {name: value[:after] for name, value in history.items()}
    fetch = searcher.population.fetch
    frozen = jnp.stack([fetch(group.frozen) for group in training.learners])
    if config.final_rounds:
        history = _tracked(fetch(searcher.population.final(training, slots)))
    es_state, result = functions.end(state.es, stage, state.candidates, history, frozen)
    progress = progress._replace(result=result, learners=training.learners)
    if stage + 1 < config.total_stages and result.fitness.finite.any():
        return _begin_stage(searcher, es_state, stage + 1), progress
    return _ended(searcher, state.replace(es=es_state)), progress


def _ended(searcher: Searcher, state: SearchState) -> SearchState:
    """The state after the last stage; its training is that of that stage."""
    over = jnp.asarray(searcher.config.total_stages, jnp.int32)
    return state.replace(stage=over)


def slots_of(searcher: Searcher, state: SearchState) -> tuple[Slot, ...]:
    """The slots in training."""
    stage = int(state.stage)
    if stage < searcher.config.num_stages:
        return searcher.stage.slots(stage, state.candidates)
    return searcher.stage.final_slots(state.candidates)


def _tracked(metrics: tuple[Metrics, ...]) -> Metrics:
    """Groups of metrics [K, P] as one table, each [K, A, P]."""
    return {name: jnp.stack([group[name] for group in metrics], 1) for name in TRACKED}


def pick_label(
    config: SearchConfig, is_zero: bool, among_finalists: bool = False
) -> str:
    """In words, by which rule the final pick of a search was made."""
    against_references = among_finalists and config.references
    if config.judge_by == "success" or against_references:
        return "closest to success"
    if is_zero:
        return "zero violation, highest return"
    return "fewest violating episodes" if among_finalists else "lowest cost"


def require_survivors(config: SearchConfig, state: ESState) -> None:
    """Refuse to go on with a search, or to name its best, after a failed stage.

    Raises:
      RuntimeError: if all candidates of a stage failed; it names the stage.
    """
    size = config.population_size
    stage = int(run_compiled(es_lib.failed_stage, state, population_size=size))
    if stage >= 0:
        raise RuntimeError(
            f"every candidate of stage {stage + 1} failed "
            "(non-finite numbers in all agents)"
        )


def best_of(config: SearchConfig, state: ESState) -> es_lib.Best:
    """The search's final pick.

    Raises:
      RuntimeError: if all candidates of a stage failed, or no stage was told yet.
    """
    require_survivors(config, state)
    if not int(state.generation):
        raise RuntimeError("the search has no best candidate before its first stage")
    return run_compiled(
        es_lib.best,
        state,
        population_size=config.population_size,
        zero_tolerance=config.zero_tolerance,
        pool_scores=config.pool_scores,
    )
