"""The AutoCost search: ask -> train every candidate -> fitness -> tell, stage by stage.

Two ways to run one and the same search: `evolve`, a host loop over jitted chunks that
can be watched, checkpointed and resumed, and `search`, a pure function of a key. Both
are made of the same pieces.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from autocost_jax import es as es_lib
from autocost_jax.config import SearchConfig, Start
from autocost_jax.costs import BANK, CostTerm, training_cost
from autocost_jax.envs.env import make_env
from autocost_jax.es import ES, ESState, Fitness, truncation_es
from autocost_jax.population import (
    Population,
    candidate_slots,
    jit_bundle,
    make_agents,
    make_population,
)
from autocost_jax.records import Key, Metrics, Slot
from autocost_jax.rollout import typical_lidars
from autocost_jax.train import Learner, final_episodes, init_learner, run_stage

# What the fitness and the report are made of, kept for every epoch of a stage.
TRACKED = (
    "ep_cost",
    "ep_return",
    "distance_travelled",
    "intrinsic_far",
    "intrinsic_near",
)
# How the first candidates are drawn, if not from N(0, init_std^2).
STARTS: dict[Start, Callable[..., jax.Array]] = {
    "monotone": es_lib.monotone_start,
    "graded": es_lib.graded_start,
}
# Purposes of a stage's keys: every key is fold_in(root, stage, purpose).
ASK, TELL, SLOTS = range(3)


class SearchState(struct.PyTreeNode):
    """Everything a search needs to go on; a checkpoint holds exactly this.

    Attributes:
      es: the evolutionary strategy's state.
      candidates: [P, D] the candidates in training.
      learners: for each algorithm, stacked [P, ...].
      stage: [] int32; `num_stages` once the search is over.
      epoch: [] int32, epochs of this stage already done.
      history: `TRACKED` metrics of this stage, each [num_epochs, A, P].
    """

    es: ESState
    candidates: jax.Array
    learners: tuple[Learner, ...]
    stage: jax.Array
    epoch: jax.Array
    history: Metrics


class StageResult(struct.PyTreeNode):
    """What a finished stage leaves.

    Attributes:
      candidates: [P, D].
      fitness: the pair (cost, return), fields [P].
      scores: `TRACKED` metrics averaged over the fitness epochs, each [A, P].
      order: [P] candidate indices, best first, by the paper's rule.
      frozen: [A, P] bool, agents that met a non-finite number.
    """

    candidates: jax.Array
    fitness: Fitness
    scores: Metrics
    order: jax.Array
    frozen: jax.Array


class Progress(NamedTuple):
    """What one chunk of `evolve` reports.

    Attributes:
      stage: stage of these epochs.
      epoch: first epoch of the chunk.
      metrics: for each algorithm, NumPy arrays [K, P].
      result: the stage's result if this chunk ended it, else None.
      learners: with a result the trained agents, for each algorithm stacked [P, ...].
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
    """

    es: ESState
    fitness: Fitness
    scores: Metrics


class StageFunctions(NamedTuple):
    """What happens around the chunks of a stage, as pure functions.

    Attributes:
      init: () -> the state of the evolutionary strategy before the first stage.
      begin: (es state, stage) -> candidates and, for each algorithm, slots.
      slots: (stage, candidates) -> slots.
      record: (history, metrics, epoch) -> history with the chunk's metrics.
      end: (es state, stage, candidates, history, frozen) -> es state and result.
    """

    init: Callable[[], ESState]
    begin: Callable[..., tuple[jax.Array, tuple[Slot, ...]]]
    slots: Callable[..., tuple[Slot, ...]]
    record: Callable[..., Metrics]
    end: Callable[..., tuple[ESState, StageResult]]


class Searcher(NamedTuple):
    """The compiled pieces of a search on given devices.

    Attributes:
      config: the search.
      root: its root key.
      population: the population program.
      stage: the functions around it, jitted.
    """

    config: SearchConfig
    root: Key
    population: Population
    stage: StageFunctions


def stage_key(root: Key, stage: jax.Array | int, purpose: int) -> Key:
    """The key of one stage for one purpose."""
    return jax.random.fold_in(jax.random.fold_in(root, stage), purpose)


def stage_slots(
    config: SearchConfig,
    root: Key,
    stage: jax.Array | int,
    candidates: jax.Array,
    bank: Sequence[CostTerm] = BANK,
) -> tuple[Slot, ...]:
    """For each algorithm the slots [P] that train c_ex + c_in of each candidate."""
    cost = training_cost("extrinsic+intrinsic", candidates[0], config.cost_limit, bank)
    size = candidates.shape[0]
    stacked = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), cost)
    stacked = stacked.replace(theta=candidates)
    key = stage_key(root, stage, SLOTS)
    return tuple(
        candidate_slots(stacked, jax.random.fold_in(key, index))
        for index in range(len(config.algorithms))
    )


def stage_result(
    config: SearchConfig,
    candidates: jax.Array,
    history: Metrics,
    frozen: jax.Array,
) -> StageResult:
    """Fitness and scores of a finished stage; a frozen agent costs +inf.

    Args:
      config: the search.
      candidates: [P, D].
      history: `TRACKED` metrics [num_epochs, A, P]; with cohorts those of whole
        episodes of the final policies, [rounds, A, P].
      frozen: [A, P] bool.
    """
    # A state that was not visited in an epoch has no intrinsic cost there: NaN.
    last = {
        name: (jnp.nanmean if name.startswith("intrinsic") else jnp.mean)(
            value[-config.fitness_epochs :], axis=0
        )
        for name, value in history.items()
    }
    broken = jnp.any(frozen, axis=0)
    is_mean = config.judge_by == "mean"
    cost = (jnp.mean if is_mean else jnp.max)(last["ep_cost"], axis=0)
    ep_return = (jnp.mean if is_mean else jnp.min)(last["ep_return"], axis=0)
    fitness = Fitness(
        cost=jnp.where(broken, jnp.inf, cost),
        ep_return=jnp.where(broken, -jnp.inf, ep_return),
    )
    return StageResult(
        candidates=candidates,
        fitness=fitness,
        scores=last,
        order=es_lib.rank(fitness, config.zero_tolerance, config.return_floor),
        frozen=frozen,
    )


def stage_functions(
    config: SearchConfig, root: Key, bank: Sequence[CostTerm] = BANK
) -> StageFunctions:
    """The functions around the chunks of a search."""
    strategy = _strategy(config)

    def begin(state: ESState, stage: jax.Array | int):
        candidates = strategy.ask(stage_key(root, stage, ASK), state)
        return candidates, slots(stage, candidates)

    def slots(stage: jax.Array | int, candidates: jax.Array) -> tuple[Slot, ...]:
        return stage_slots(config, root, stage, candidates, bank)

    def record(history: Metrics, metrics: tuple[Metrics, ...], epoch: jax.Array | int):
        return {
            name: jax.lax.dynamic_update_slice_in_dim(
                value, jnp.stack([group[name] for group in metrics], 1), epoch, 0
            )
            for name, value in history.items()
        }

    def end(
        state: ESState,
        stage: jax.Array | int,
        candidates: jax.Array,
        history: Metrics,
        frozen: jax.Array,
    ):
        result = stage_result(config, candidates, history, frozen)
        key = stage_key(root, stage, TELL)
        return strategy.tell(key, state, candidates, result.fitness), result

    return StageFunctions(strategy.init, begin, slots, record, end)


def _strategy(config: SearchConfig) -> ES:
    """The strategy with the options that look at the world's typical places."""
    if config.start == "normal" and not config.keep_level:
        return truncation_es(config)
    env = make_env(config.train.env)

    def lidars() -> jax.Array:
        return typical_lidars(env, jax.random.key(0))

    def start(key: Key) -> jax.Array:
        size, std = config.population_size, config.init_std
        return STARTS[config.start](key, size, std, lidars(), config.network)

    def adjust(key: Key, elites: jax.Array, children: jax.Array) -> jax.Array:
        std = config.mutation_std
        return es_lib.keep_level(key, elites, children, lidars(), std)

    return truncation_es(
        config,
        start if config.start in STARTS else None,
        adjust if config.keep_level else None,
    )


def search(
    config: SearchConfig, bank: Sequence[CostTerm] = BANK
) -> Callable[[Key], SearchResult]:
    """The whole search as one pure function of its root key; jit or vmap it."""
    env = make_env(config.train.env)
    agents = make_agents(config.algorithms, config.train, env)

    def run(root: Key) -> SearchResult:
        functions = stage_functions(config, root, bank)

        def body(state: ESState, stage: jax.Array):
            candidates, slots = functions.begin(state, stage)
            learners = tuple(
                jax.vmap(lambda slot, agent=agent: init_learner(agent, slot))(group)
                for agent, group in zip(agents, slots, strict=True)
            )
            learners, metrics = run_stage(
                env, agents, config.train, learners, slots, bank
            )
            if config.final_rounds:
                metrics = final_episodes(
                    env, agents, config.train, learners, slots, config.final_rounds
                )
            history = _tracked(metrics)
            frozen = jnp.stack([group.frozen for group in learners])
            state, result = functions.end(state, stage, candidates, history, frozen)
            return state, (result.fitness, result.scores)

        stages = jnp.arange(config.num_stages)
        state, (fitness, scores) = jax.lax.scan(body, functions.init(), stages)
        return SearchResult(es=state, fitness=fitness, scores=scores)

    return run


def make_searcher(
    config: SearchConfig,
    devices: Sequence[Any] | None = None,
    bank: Sequence[CostTerm] = BANK,
) -> Searcher:
    """Build the program of a search; nothing is compiled yet."""
    env = make_env(config.train.env)
    agents = make_agents(config.algorithms, config.train, env)
    root = jax.random.key(config.seed)
    return Searcher(
        config=config,
        root=root,
        population=make_population(
            env, agents, config.train, bank, devices, config.final_rounds
        ),
        stage=jit_bundle(stage_functions(config, root, bank)),
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
      state: where to continue; default: from the start. Its learners are consumed.
      searcher: from `make_searcher(config, ...)`; default: one device.

    Yields:
      After each chunk the state, ready to be saved and continued from, and what
      happened. A yielded state's learners are consumed by the next chunk.

    Raises:
      RuntimeError: after a stage, if all its candidates failed; it names the stage.
        A state in which that has happened raises it again at once.
    """
    searcher = make_searcher(config) if searcher is None else searcher
    state = init_search(searcher) if state is None else state
    require_survivors(config, state.es)
    while int(state.stage) < config.num_stages:
        state, progress = _run_chunk(searcher, state)
        yield state, progress
        if progress.result is not None:
            require_survivors(config, state.es)


def _begin_stage(searcher: Searcher, es_state: ESState, stage: int) -> SearchState:
    config = searcher.config
    candidates, slots = searcher.stage.begin(es_state, stage)
    shape = (config.train.num_epochs, len(config.algorithms), config.population_size)
    return SearchState(
        es=es_state,
        candidates=candidates,
        learners=searcher.population.init(slots),
        stage=jnp.asarray(stage, jnp.int32),
        epoch=jnp.zeros((), jnp.int32),
        history={name: jnp.zeros(shape, jnp.float32) for name in TRACKED},
    )


def _run_chunk(searcher: Searcher, state: SearchState) -> tuple[SearchState, Progress]:
    """One chunk; at a stage's end also `tell` and the beginning of the next stage."""
    config, functions = searcher.config, searcher.stage
    stage, epoch = int(state.stage), int(state.epoch)
    slots = functions.slots(stage, state.candidates)
    learners, metrics = searcher.population.chunk(state.learners, slots, epoch)
    metrics = searcher.population.fetch(metrics)
    history = functions.record(state.history, metrics, epoch)
    after = epoch + config.train.chunk_epochs
    progress = Progress(stage, epoch, jax.tree.map(np.asarray, metrics))
    state = state.replace(
        learners=learners, history=history, epoch=jnp.asarray(after, jnp.int32)
    )
    if after < config.train.num_epochs:
        return state, progress
    fetch = searcher.population.fetch
    frozen = jnp.stack([fetch(group.frozen) for group in learners])
    if config.final_rounds:
        history = _tracked(fetch(searcher.population.final(learners, slots)))
    es_state, result = functions.end(state.es, stage, state.candidates, history, frozen)
    progress = progress._replace(result=result, learners=learners)
    if stage + 1 < config.num_stages:
        return _begin_stage(searcher, es_state, stage + 1), progress
    over = jnp.asarray(config.num_stages, jnp.int32)
    return state.replace(es=es_state, stage=over), progress


def _tracked(metrics: tuple[Metrics, ...]) -> Metrics:
    """Groups of metrics [K, P] as one table, each [K, A, P]."""
    return {name: jnp.stack([group[name] for group in metrics], 1) for name in TRACKED}


def pick_label(config: SearchConfig, is_zero: bool, ep_return: float) -> str:
    """In words, by which rule the final pick of a search was made."""
    label = "zero violation, highest return" if is_zero else "lowest cost"
    floor = config.return_floor
    if floor is None:
        return label
    if ep_return < floor:
        return f"highest return, as none reached {floor:g}"
    return label if is_zero else f"{label} of those that return at least {floor:g}"


def require_survivors(config: SearchConfig, state: ESState) -> None:
    """Refuse to go on with a search, or to name its best, after a failed stage.

    Raises:
      RuntimeError: if all candidates of a stage failed; it names the stage.
    """
    stage = int(es_lib.failed_stage(state, config.population_size))
    if stage >= 0:
        raise RuntimeError(
            f"every candidate of stage {stage} failed "
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
    return es_lib.best(
        state, config.population_size, config.zero_tolerance, config.return_floor
    )
