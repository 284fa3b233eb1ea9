"""The evolutionary search as pure functions over stacked pytrees.

A candidate is any pytree; a population stacks them on a leading axis P. The search
knows nothing of how the fitness, a pair (cost, return), was obtained.

Source: He, Zhao & Liu 2023, "AutoCost". Ours where the paper is silent: see
`SearchConfig`; ties fall to the earlier candidate, children are dealt round-robin to
the elites in rank order, and elites are kept in front of the children.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from autocost_jax.config import SearchConfig
from autocost_jax.records import Key, root_key


class Fitness(struct.PyTreeNode):
    """How good the candidates were; lower cost first, then higher return.

    Attributes:
      cost: [P] what is to be low, such as the mean extrinsic cost per episode; +inf for
        a broken candidate.
      ep_return: [P] return per episode; -inf for a broken candidate.
    """

    cost: jax.Array
    ep_return: jax.Array

    @property
    def finite(self) -> jax.Array:
        """[P] bool, False where a candidate is broken."""
        return jnp.isfinite(self.cost) & jnp.isfinite(self.ep_return)


class ESState(struct.PyTreeNode):
    """What the search remembers between stages.

    Attributes:
      generation: [] int32, stages told so far, G.
      elites: stacked pytree [E, ...], the parents of the next candidates.
      archive: stacked pytree [G_max * P, ...], every candidate told so far.
      archive_fitness: its fitness; +inf, -inf where nothing was told yet.
    """

    generation: jax.Array
    elites: Any
    archive: Any
    archive_fitness: Fitness


class Best(struct.PyTreeNode):
    """The final pick of a search.

    There is none if nothing was told yet, or if a stage failed altogether, see
    `failed_stage`. Then the candidate is NaN, its cost +inf and its return -inf, and
    `generation` and `index` are -1.

    Attributes:
      candidate: pytree of the best candidate.
      cost: [] its cost.
      ep_return: [] its return.
      zero_violation: [] bool; False: no candidate that may be picked reached zero,
        and this one has the lowest cost.
      generation: [] int32 stage in which it was told.
      index: [] int32 its place in that stage.
    """

    candidate: Any
    cost: jax.Array
    ep_return: jax.Array
    zero_violation: jax.Array
    generation: jax.Array
    index: jax.Array


class ES(NamedTuple):
    """A strategy as pure functions.

    Attributes:
      init: () -> state.
      ask: (key, state) -> candidates, stacked [P, ...]; the key is consumed.
      tell: (key, state, candidates, fitness) -> state; the key is consumed.
    """

    init: Callable[[], ESState]
    ask: Callable[[Key, ESState], Any]
    tell: Callable[[Key, ESState, Any, Fitness], ESState]


def rank(fitness: Fitness, zero_tolerance: float = 0.0) -> jax.Array:
    """Indices [P], best first: cost (<= tolerance counts as 0), then return.

    One lexicographic sort covers both branches of the paper's rule: with more
    zero-violation candidates than elites the highest returns win, otherwise the lowest
    costs. Anything non-finite comes last.
    """
    ok = fitness.finite
    cost = jnp.where(fitness.cost <= zero_tolerance, 0.0, fitness.cost)
    cost = jnp.where(ok, cost, jnp.inf)
    loss = jnp.where(ok, -fitness.ep_return, jnp.inf)
    return jnp.lexsort((loss, cost))


def select(
    candidates: Any,
    fitness: Fitness,
    num_elites: int,
    zero_tolerance: float = 0.0,
) -> tuple[Any, jax.Array]:
    """The best candidates and their indices, in rank order.

    Args:
      candidates: stacked pytree [P, ...].
      fitness: fields [P].
      num_elites: E.
      zero_tolerance: cost up to which a candidate counts as free of violations.

    Returns:
      Elites, stacked [E, ...], and their indices [E].

    Raises:
      ValueError: if num_elites is not in [1, P].
    """
    size = fitness.cost.shape[0]
    if not 1 <= num_elites <= size:
        raise ValueError(f"num_elites must be in [1, {size}], got {num_elites}")
    index = rank(fitness, zero_tolerance)[:num_elites]
    return jax.tree.map(lambda x: x[index], candidates), index


def mutate(
    key: Key,
    elites: Any,
    num_children: int,
    std: float = 1.0,
    low: float = 0.5,
    high: float = 2.0,
) -> Any:
    """Children of the elites, dealt round-robin, each by one of two mutations.

    theta + z with z ~ N(0, std^2), or theta * z with z ~ U[low, high], element-wise;
    which one is a fair coin for each child.

    Args:
      key: consumed.
      elites: stacked pytree [E, ...].
      num_children: C.
      std: deviation of the additive mutation.
      low: smallest factor of the multiplicative mutation.
      high: largest factor.

    Returns:
      Stacked pytree [C, ...].
    """
    leaves, treedef = jax.tree.flatten(elites)
    key_kind, *keys = jax.random.split(key, 1 + len(leaves))
    is_additive = jax.random.bernoulli(key_kind, 0.5, (num_children,))
    children = []
    for leaf, leaf_key in zip(leaves, keys, strict=True):
        parent = leaf[jnp.arange(num_children) % leaf.shape[0]]
        key_add, key_scale = jax.random.split(leaf_key)
        noise = std * jax.random.normal(key_add, parent.shape, parent.dtype)
        factor = jax.random.uniform(key_scale, parent.shape, parent.dtype, low, high)
        additive = is_additive.reshape(-1, *[1] * (parent.ndim - 1))
        children.append(jnp.where(additive, parent + noise, parent * factor))
    return treedef.unflatten(children)


def pool(candidates: Any, fitness: Fitness) -> Fitness:
    """For each row the mean fitness of all rows that hold the same candidate.

    An elite is trained again in every stage: its scores are then as many, and the
    luckiest of them decides nothing. One broken training breaks the mean.

    Args:
      candidates: stacked pytree [N, ...].
      fitness: fields [N].
    """
    same = _same(candidates)

    def mean(values: jax.Array) -> jax.Array:
        rows = jnp.where(same, values[None], 0.0)  # 0 x inf would be NaN
        return jnp.sum(rows, 1) / jnp.sum(same, 1)

    return jax.tree.map(mean, fitness)


def _same(candidates: Any) -> jax.Array:
    """[N, N] bool, which rows hold the same candidate."""
    leaves = jax.tree.leaves(candidates)
    same = jnp.ones((leaves[0].shape[0],) * 2, bool)
    for leaf in leaves:
        equal = leaf[:, None] == leaf[None]
        same &= equal.reshape(*same.shape, -1).all(-1)
    return same


def _empty_state(shapes: Any, num_elites: int, capacity: int) -> ESState:
    """The state before the first stage, for candidates of these shapes [P, ...]."""

    def zeros(num: int) -> Any:
        return jax.tree.map(
            lambda leaf: jnp.zeros((num, *leaf.shape[1:]), leaf.dtype), shapes
        )

    return ESState(
        generation=jnp.zeros((), jnp.int32),
        elites=zeros(num_elites),
        archive=zeros(capacity),
        archive_fitness=Fitness(
            cost=jnp.full(capacity, jnp.inf, jnp.float32),
            ep_return=jnp.full(capacity, -jnp.inf, jnp.float32),
        ),
    )


def _normal_start(config: SearchConfig, key: Key) -> jax.Array:
    shape = (config.population_size, config.theta_size)
    return config.init_std * jax.random.normal(key, shape, jnp.float32)


def _paper_mutation(config: SearchConfig) -> Callable[[Key, Any, int], Any]:
    low, high = config.mutation_low, config.mutation_high
    return functools.partial(mutate, std=config.mutation_std, low=low, high=high)


def _paper_rank(config: SearchConfig) -> Callable[[Fitness], jax.Array]:
    return functools.partial(rank, zero_tolerance=config.zero_tolerance)


def truncation_es(
    config: SearchConfig,
    init: Callable[[Key], Any] | None = None,
    mutate: Callable[[Key, Any, int], Any] | None = None,
    rank: Callable[[Fitness], jax.Array] | None = None,
) -> ES:
    """The paper's search over any pytree: keep the best, mutate, repeat.

    `config.selection` "random" replaces the ranking by a random choice of elites, the
    control that shows what selection adds. With `config.pool_scores` candidates are
    ranked by the mean over all stages that trained them, see `pool`.

    Args:
      config: sizes, and the numbers of the default functions.
      init: key -> first candidates, a stacked pytree [P, ...]; default: theta [P, 41]
        of N(0, `config.init_std`^2).
      mutate: (key, elites [E, ...], C) -> children [C, ...]; default: the paper's
        two mutations.
      rank: fitness [P] -> indices [P], best first; default: the paper's rule.
    """
    size, elites = config.population_size, config.num_elites
    first = init or functools.partial(_normal_start, config)
    vary = mutate or _paper_mutation(config)
    order = rank or _paper_rank(config)

    def start() -> ESState:
        shapes = jax.eval_shape(first, root_key(0))
        return _empty_state(shapes, elites, config.num_stages * size)

    def ask(key: Key, state: ESState) -> Any:
        key_init, key_mutate = jax.random.split(key)
        children = vary(key_mutate, state.elites, size - elites)
        later = jax.tree.map(
            lambda old, new: jnp.concatenate([old, new]), state.elites, children
        )
        return jax.lax.cond(
            state.generation == 0, lambda: first(key_init), lambda: later
        )

    def tell(key: Key, state: ESState, candidates: Any, fitness: Fitness) -> ESState:
        place = state.generation * size

        def put(old: jax.Array, new: jax.Array) -> jax.Array:
            new = new.astype(old.dtype)
            return jax.lax.dynamic_update_slice_in_dim(old, new, place, 0)

        archive = jax.tree.map(put, state.archive, candidates)
        archive_fitness = jax.tree.map(put, state.archive_fitness, fitness)
        if config.pool_scores:
            pooled = pool(archive, archive_fitness)
            fitness = jax.tree.map(
                lambda x: jax.lax.dynamic_slice_in_dim(x, place, size, 0), pooled
            )
        if config.selection == "paper":
            parents = order(fitness)[:elites]
        else:
            parents = jax.random.permutation(key, size)[:elites]
        return ESState(
            generation=state.generation + 1,
            elites=jax.tree.map(lambda x: x[parents], candidates),
            archive=archive,
            archive_fitness=archive_fitness,
        )

    return ES(start, ask, tell)


def failed_stage(state: ESState, population_size: int) -> jax.Array:
    """The first stage told in which every candidate broke, [] int32; -1 without any.

    Such a stage has nothing to select from: the search has failed, whatever was told
    before or after it.
    """
    finite = state.archive_fitness.finite.reshape(-1, population_size)
    alive = jnp.any(finite, axis=1)
    failed = ~alive & (jnp.arange(alive.shape[0]) < state.generation)
    return jnp.where(jnp.any(failed), jnp.argmax(failed), -1).astype(jnp.int32)


def top(
    state: ESState, num: int, zero_tolerance: float = 0.0, pool_scores: bool = False
) -> tuple[Fitness, jax.Array]:
    """The best distinct candidates of all stages.

    Args:
      state: of the strategy.
      num: M.
      zero_tolerance: see `rank`.
      pool_scores: judge each by all stages that trained it, see `pool`.

    Returns:
      The fitness that the archive's candidates are judged by, and the places [M] of
      the best in the archive; broken candidates come when no others are left.
    """
    fitness = state.archive_fitness
    if not pool_scores:
        return fitness, rank(fitness, zero_tolerance)[:num]
    fitness = pool(state.archive, fitness)
    same = _same(state.archive)
    again = jnp.any(jnp.tril(same, -1), axis=1)  # an earlier row holds it, too
    worst = jnp.where(again, jnp.inf, fitness.cost)
    return fitness, rank(fitness.replace(cost=worst), zero_tolerance)[:num]


def best(
    state: ESState,
    population_size: int,
    zero_tolerance: float = 0.0,
    pool_scores: bool = False,
) -> Best:
    """The final pick: of all zero-violation candidates the one of highest return.

    Without any, that of lowest cost; `zero_violation` says which it is. Of a failed
    search there is no pick, see `Best`.
    """
    fitness, order = top(state, 1, zero_tolerance, pool_scores)
    index = order[0]
    is_failed = failed_stage(state, population_size) >= 0
    found = fitness.finite[index] & ~is_failed

    def pick(x: jax.Array) -> jax.Array:
        is_float = jnp.issubdtype(x.dtype, jnp.floating)
        return jnp.where(found, x[index], jnp.nan) if is_float else x[index]

    place = jnp.where(found, index, -1).astype(jnp.int32)
    return Best(
        candidate=jax.tree.map(pick, state.archive),
        cost=jnp.where(found, fitness.cost[index], jnp.inf),
        ep_return=jnp.where(found, fitness.ep_return[index], -jnp.inf),
        zero_violation=found & (fitness.cost[index] <= zero_tolerance),
        generation=place // population_size,  # of -1 it is -1
        index=jnp.where(found, place % population_size, -1),
    )
