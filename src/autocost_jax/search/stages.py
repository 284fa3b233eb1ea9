"""What happens around the training of a stage, as pure functions.

A stage trains, with every algorithm, each candidate and each reference cost with some
seeds. The stage of the finalists is one more of the same kind, so that it runs in the
same program: what is trained is data.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from autocost_jax import es as es_lib
from autocost_jax.config import SearchConfig
from autocost_jax.costs import BANK, CostTerm, training_cost
from autocost_jax.envs.env import Env
from autocost_jax.es import ES, ESState, Fitness, truncation_es
from autocost_jax.records import Key, Metrics, Slot, TrainingCost, root_key
from autocost_jax.rollout import typical_lidars
from autocost_jax.search.starts import graded_start
from autocost_jax.search.success import shortfall

# What the fitness and the report are made of, kept for every epoch of a stage.
TRACKED = (
    "ep_cost",
    "ep_return",
    "violating_worlds",
    "steps_outside",
    "intrinsic_far",
    "intrinsic_near",
)
# The costs that candidates are compared with; the first says what success is.
REFERENCES = {
    "extrinsic": "extrinsic",
    "safety_margin_3x": "extrinsic+safety_margin_3x",
}
# Purposes of a stage's keys: every key is fold_in(root, stage, purpose).
ASK, TELL, SLOTS = range(3)


class StageResult(struct.PyTreeNode):
    """What a finished stage leaves; all but `candidates` are means over the seeds.

    Attributes:
      candidates: [P, D].
      fitness: fields [P].
      scores: `TRACKED` metrics averaged over the fitness epochs, each [A, P].
      references: the same of the reference costs, each [A, R], without frozen agents.
      order: [P] candidate indices, best first, as `rank` has them.
      frozen: [A, P] bool, whether an agent met a non-finite number.
    """

    candidates: jax.Array
    fitness: Fitness
    scores: Metrics
    references: Metrics
    order: jax.Array
    frozen: jax.Array


class StageFunctions(NamedTuple):
    """What happens around the chunks of a stage.

    Attributes:
      init: () -> the state of the evolutionary strategy before the first stage.
      begin: (es state, stage) -> candidates and, for each algorithm, slots.
      slots: (stage, candidates) -> slots.
      record: (history, metrics, epoch) -> history with the chunk's metrics.
      end: (es state, stage, candidates, history, frozen) -> es state and result.
      begin_final: es state -> the best P candidates of all stages, best first, and the
        slots that train the first of them as finalists.
      final_slots: candidates -> these slots.
    """

    init: Callable[[], ESState]
    begin: Callable[..., tuple[jax.Array, tuple[Slot, ...]]]
    slots: Callable[..., tuple[Slot, ...]]
    record: Callable[..., Metrics]
    end: Callable[..., tuple[ESState, StageResult]]
    begin_final: Callable[[ESState], tuple[jax.Array, tuple[Slot, ...]]]
    final_slots: Callable[[jax.Array], tuple[Slot, ...]]


class Deal(NamedTuple):
    """Which cost and which seed each slot of an algorithm trains.

    Attributes:
      cost: [N] index into the costs: candidates (or finalists), then references.
      seed: [N].
      num_costs: C; the first C x `num_seeds` slots are the costs' in turn, the others
        are copies of the first slot.
      num_seeds: of each cost.
    """

    cost: np.ndarray
    seed: np.ndarray
    num_costs: int
    num_seeds: int

    def table(self, values: Any) -> Any:
        """Values [..., N] as [..., C, seeds]."""
        kept = values[..., : self.num_costs * self.num_seeds]
        return kept.reshape(*values.shape[:-1], self.num_costs, self.num_seeds)


def deal(config: SearchConfig, is_final: bool = False) -> Deal:
    """How the slots of an algorithm are dealt in a stage, or in the finalists'."""
    count = config.num_finalists if is_final else config.population_size
    seeds = config.final_seeds if is_final else config.seeds_per_candidate
    costs = count + config.num_references
    spare = np.zeros(config.slots_per_algorithm - costs * seeds, int)
    return Deal(
        cost=np.concatenate([np.repeat(np.arange(costs), seeds), spare]),
        seed=np.concatenate([np.tile(np.arange(seeds), costs), spare]),
        num_costs=costs,
        num_seeds=seeds,
    )


def stage_key(root: Key, stage: jax.Array | int, purpose: int) -> Key:
    """The key of one stage for one purpose."""
    return jax.random.fold_in(jax.random.fold_in(root, stage), purpose)


def stage_costs(
    config: SearchConfig, candidates: jax.Array, bank: Sequence[CostTerm] = BANK
) -> TrainingCost:
    """The stacked costs [P + R] of a stage: c_ex + c_in of each candidate, references.

    Args:
      config: the search.
      candidates: [P, D].
      bank: the cost terms.
    """
    limit = config.cost_limit
    names = ["extrinsic+intrinsic"] * candidates.shape[0]
    thetas = list(candidates)
    if config.references:
        names += REFERENCES.values()
        thetas += [jnp.zeros_like(candidates[0])] * len(REFERENCES)
    costs = [
        training_cost(name, theta, limit, bank)
        for name, theta in zip(names, thetas, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *costs)


def stage_slots(
    config: SearchConfig,
    root: Key,
    stage: jax.Array | int,
    candidates: jax.Array,
    bank: Sequence[CostTerm] = BANK,
    is_final: bool = False,
) -> tuple[Slot, ...]:
    """For each algorithm the slots [N] of a stage, or of the finalists'.

    All costs share the keys of the seeds (common random numbers). Of the candidates in
    the finalists' stage the first `num_finalists` are trained.
    """
    dealt = deal(config, is_final)
    if is_final:
        candidates = candidates[: config.num_finalists]
    costs = stage_costs(config, candidates, bank)
    cost = jax.tree.map(lambda leaf: leaf[dealt.cost], costs)
    key = stage_key(root, stage, SLOTS)

    def group(index: int) -> Slot:
        own = jax.random.fold_in(key, index)
        return Slot(
            cost=cost,
            key=jax.vmap(lambda seed: jax.random.fold_in(own, seed))(dealt.seed),
            constrained=jnp.ones(len(dealt.seed), jnp.float32),
        )

    return tuple(group(index) for index in range(len(config.algorithms)))


def stage_result(
    config: SearchConfig,
    candidates: jax.Array,
    history: Metrics,
    frozen: jax.Array,
) -> StageResult:
    """Fitness and scores of a finished stage; a frozen agent costs +inf.

    A candidate's scores are the means over its seeds. Its return is the mean over the
    algorithms; so is its cost, but with `judge_by="success"`, where it is how far the
    candidate is from success, see `shortfall`.

    Args:
      config: the search.
      candidates: [P, D].
      history: `TRACKED` metrics [num_epochs, A, N]; with cohorts those of whole
        episodes of the final policies, [rounds, A, N].
      frozen: [A, N] bool.
    """
    dealt, size = deal(config), config.population_size
    # A state that was not visited in an epoch has no intrinsic cost there: NaN.
    last = {
        name: dealt.table(value[-config.fitness_epochs :])
        for name, value in history.items()
    }
    frozen = dealt.table(frozen)  # [A, C, S]
    scores = {
        name: (jnp.nanmean if name.startswith("intrinsic") else jnp.mean)(
            value[:, :, :size], axis=(0, -1)
        )
        for name, value in last.items()
    }
    references = {  # of the seeds that did not break; NaN if all did
        name: jnp.nanmean(
            jnp.where(frozen[:, size:], jnp.nan, value[:, :, size:]), axis=(0, -1)
        )
        for name, value in last.items()
    }
    frozen = jnp.any(frozen[:, :size], axis=-1)
    broken = jnp.any(frozen, axis=0)
    if config.judge_by == "cost":
        cost = jnp.mean(scores["ep_cost"], axis=0)
    else:
        names = ("violating_worlds", "ep_return")
        plain = (references[name][:, 0] for name in names)
        cost = shortfall(*(scores[name] for name in names), *plain)
    fitness = Fitness(
        cost=jnp.where(broken, jnp.inf, cost),
        ep_return=jnp.where(broken, -jnp.inf, jnp.mean(scores["ep_return"], axis=0)),
    )
    return StageResult(
        candidates=candidates,
        fitness=fitness,
        scores=scores,
        references=references,
        order=es_lib.rank(fitness, config.zero_tolerance),
        frozen=frozen,
    )


def stage_functions(
    config: SearchConfig, env: Env, root: Key, bank: Sequence[CostTerm] = BANK
) -> StageFunctions:
    """The functions around the chunks of a search's stages."""
    strategy = make_strategy(config, env)

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

    def begin_final(state: ESState):
        rule = (config.zero_tolerance, config.pool_scores)
        _, order = es_lib.top(state, config.population_size, *rule)
        candidates = jax.tree.map(lambda leaf: leaf[order], state.archive)
        return candidates, final_slots(candidates)

    def final_slots(candidates: jax.Array) -> tuple[Slot, ...]:
        stage = config.num_stages
        return stage_slots(config, root, stage, candidates, bank, is_final=True)

    return StageFunctions(
        strategy.init, begin, slots, record, end, begin_final, final_slots
    )


def make_strategy(config: SearchConfig, env: Env) -> ES:
    """The strategy, with a start that looks at the world's typical places if asked."""
    if config.start == "normal":
        return truncation_es(config)

    def start(key: Key) -> jax.Array:
        lidars = typical_lidars(env, root_key(0))
        size, std = config.population_size, config.init_std
        return graded_start(key, size, std, lidars, config.network)

    return truncation_es(config, init=start)
