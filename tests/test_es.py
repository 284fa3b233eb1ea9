"""Selection, mutation and the archive: the paper's rules as properties and goldens."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax import EnvConfig, make_env, preset
from autocost_jax.config import SearchConfig
from autocost_jax.costs import HIDDEN, intrinsic_cost
from autocost_jax.es import (
    Fitness,
    best,
    failed_stage,
    mutate,
    pool,
    rank,
    select,
    top,
    truncation_es,
)
from autocost_jax.population import jit_bundle
from autocost_jax.rollout import typical_lidars
from autocost_jax.search.stages import make_strategy
from autocost_jax.search.starts import (
    LOUD_COSTS,
    LOUD_PLACE,
    QUIET_COST,
    QUIET_PLACES,
    graded_start,
)

SIGMAS = 5.0  # of the estimate: a fixed key passes or fails for good
SMALL = SearchConfig(population_size=6, num_elites=2, num_stages=3)
SMALL_ES = jit_bundle(truncation_es(SMALL))  # compiled once for many tests


def make_fitness(cost, ep_return):
    return Fitness(
        cost=jnp.asarray(cost, jnp.float32),
        ep_return=jnp.asarray(ep_return, jnp.float32),
    )


def selected(fitness, num_elites=2, **options):
    candidates = jnp.arange(fitness.cost.shape[0])
    elites, index = select(candidates, fitness, num_elites, **options)
    np.testing.assert_array_equal(elites, index)
    return index.tolist()


@pytest.fixture(scope="module")
def places():
    """Readings [256, 8] at typical places."""
    env = make_env(EnvConfig(physics="closed_form"))
    return jax.jit(lambda key: typical_lidars(env, key, 256))(jax.random.key(1))


jit_mutate = jax.jit(mutate, static_argnums=2)


@functools.partial(jax.jit, static_argnames="network")
def graded(key, places, quiet_places, loud_costs, network: Any = "lidar_mlp"):
    """200 costs of the graded start, and what they say of the places [200, M]."""
    theta = graded_start(key, 200, 8.0, places, network, quiet_places, loud_costs)
    return theta, jax.vmap(lambda theta: intrinsic_cost(theta, places))(theta)


# Selection -------------------------------------------------------------------


def golden_fitness(zero, ep_return=None):
    """Twenty candidates; those not in `zero` cost 1 to 20, candidate 12 least."""
    cost = np.arange(1.0, 21.0)
    cost[12], cost[0] = 0.5, 13.0
    cost[list(zero)] = 0.0
    returns = np.linspace(30.0, 20.0, 20)  # costly candidates earn most
    for index, value in (ep_return or {}).items():
        returns[index] = value
    return make_fitness(cost, returns)


def test_golden_one_zero_then_the_lowest_cost():
    assert selected(golden_fitness({7})) == [7, 12]


def test_golden_more_zeros_than_elites():
    returns = {3: 10.0, 7: 12.5, 11: 9.0}
    assert selected(golden_fitness({3, 7, 11}, returns)) == [7, 3]


@pytest.mark.parametrize("returns", [(1.0, 2.0), (2.0, 1.0), (-5.0, 100.0)])
def test_golden_as_many_zeros_as_elites(returns):
    fitness = golden_fitness({3, 7}, dict(zip((3, 7), returns, strict=True)))
    assert sorted(selected(fitness)) == [3, 7]


def test_the_tolerance_decides_what_is_zero():
    fitness = make_fitness([1e-3, 0.0, 2e-3, 5.0], [9.0, 1.0, 10.0, 99.0])
    assert selected(fitness) == [1, 0]
    assert selected(fitness, zero_tolerance=1e-3) == [0, 1]
    assert selected(fitness, zero_tolerance=2e-3) == [2, 0]


BROKEN = [
    (np.nan, 1.0),
    (np.inf, 1.0),
    (-np.inf, 1.0),
    (0.0, np.nan),
    (0.0, np.inf),
    (0.0, -np.inf),
    (np.inf, -np.inf),
]


@pytest.mark.parametrize(("cost", "ep_return"), BROKEN)
def test_what_is_not_finite_comes_last(cost, ep_return):
    """Behind even the most expensive candidate that is finite."""
    fitness = make_fitness([cost, 1e30, cost, 2.0], [ep_return, -1e30, ep_return, 0.0])
    assert rank(fitness).tolist() == [3, 1, 0, 2]


def test_ties_fall_to_the_earlier_candidate():
    fitness = make_fitness([1.0, 0.0, 1.0, 0.0, 0.0], [5.0, 2.0, 5.0, 2.0, 3.0])
    assert rank(fitness).tolist() == [4, 1, 3, 0, 2]


def test_equal_costs_fall_to_the_higher_return():
    fitness = make_fitness([3.0, 3.0, 3.0], [1.0, 7.0, 4.0])
    assert rank(fitness).tolist() == [1, 2, 0]


# Pooled scores ---------------------------------------------------------------


def test_pooling_is_the_mean_over_all_trainings_of_a_candidate():
    candidates = {"w": jnp.array([[1.0], [2.0], [1.0], [3.0], [2.0]])}
    fitness = make_fitness([5.0, 1.0, 0.0, 7.0, np.inf], [1.0, 2.0, 3.0, 4.0, -np.inf])
    pooled = pool(candidates, fitness)
    assert pooled.cost.tolist() == [2.5, np.inf, 2.5, 7.0, np.inf]
    assert pooled.ep_return.tolist() == [2.0, -np.inf, 2.0, 4.0, -np.inf]


def test_a_lucky_retraining_is_no_zero_violation(key):
    """The same theta cost 5 and then 0: it is at 2.5, and another one is best."""
    config = dataclasses.replace(SMALL, pool_scores=True, num_elites=1)
    es = jit_bundle(truncation_es(config))
    state, size = es.init(), SMALL.population_size
    costs = ([5.0, *[9.0] * (size - 1)], [0.0, 2.0, *[9.0] * (size - 2)])
    for stage, cost in enumerate(costs):
        candidates = es.ask(jax.random.fold_in(key, stage), state)
        state = es.tell(key, state, candidates, make_fitness(cost, [0.0] * size))
    pick = best(state, size, pool_scores=True)
    assert place(pick) == (1, 1, False)
    np.testing.assert_array_equal(state.elites[0], candidates[1])
    assert place(best(state, size)) == (1, 0, True)  # unpooled, the paper's archive
    _, order = top(state, 3, pool_scores=True)
    assert len({state.archive[i].tobytes() for i in np.asarray(order)}) == 3
    assert order.tolist()[:2] == [size + 1, 0]


# Where a search begins -------------------------------------------------------


@pytest.mark.parametrize("network", ["lidar_mlp", "min_distance"])
def test_a_graded_start_is_as_loud_as_it_was_drawn(key, network, places):
    theta, costs = graded(key, places, QUIET_PLACES, LOUD_COSTS, network)
    costs = np.asarray(costs)
    quiet = 100 * (costs < QUIET_COST).mean(1)
    assert quiet.min() > QUIET_PLACES[0] - 1
    assert quiet.max() < QUIET_PLACES[1] + 1
    np.testing.assert_allclose(quiet.mean(), np.mean(QUIET_PLACES), atol=SIGMAS * 0.9)
    low, high = LOUD_COSTS
    loud = np.percentile(costs, LOUD_PLACE, axis=1)
    inside = (loud > 0.9 * low) & (loud < 1.1 * high)
    assert inside.mean() > 0.9  # the others' units are all but off
    share = np.log(loud[inside] / low) / np.log(high / low)
    np.testing.assert_allclose(share.mean(), 0.5, atol=SIGMAS * 0.29 / 200**0.5)
    nearer = jax.jit(jax.vmap(intrinsic_cost, (0, None)))(theta, 1.1 * places)
    assert bool((nearer >= costs).all())


def test_a_graded_start_hears_all_directions(key, places):
    """No hidden unit is all but deaf in one of the eight: |N| weights would be."""
    theta = np.asarray(graded(key, places, QUIET_PLACES, LOUD_COSTS)[0])
    weights = theta[:, : 8 * HIDDEN].reshape(-1, 8, HIDDEN)
    weakest = weights.min(1) / weights.mean(1)
    assert weakest.mean() > 0.5
    deaf = np.abs(np.random.default_rng(0).normal(size=weights.shape))
    assert (deaf.min(1) / deaf.mean(1)).mean() < 0.25


def test_mutations_of_the_presets_leave_children_near_their_parents(key, places):
    """Where they are loud; three times as large ones do not."""
    theta, costs = graded(key, places, QUIET_PLACES, LOUD_COSTS)
    config = preset("laptop")

    def logit(costs):
        loud = np.percentile(np.asarray(costs, float), LOUD_PLACE, axis=1)
        loud = loud.clip(1e-6, 1 - 1e-6)  # float32 knows no more
        return np.log(loud / (1 - loud))

    def moved(std, low, high):
        children = mutate(key, theta, len(theta), std, low, high)
        seen = jax.jit(jax.vmap(intrinsic_cost, (0, None)))(children, places)
        return (logit(seen) - logit(costs)).std()

    near = moved(config.mutation_std, config.mutation_low, config.mutation_high)
    assert near < 1.0
    assert moved(0.3, 0.9, 1.1) > 2.0 * near


def test_a_graded_start_keeps_to_other_ranges(key, places):
    costs = np.asarray(graded(key, places, (60.0, 70.0), (0.4, 0.5))[1])
    quiet = 100 * (costs < QUIET_COST).mean(1)
    assert (quiet > 59).all()
    assert (quiet < 71).all()
    assert np.median(np.percentile(costs, LOUD_PLACE, axis=1)) > 0.35


def test_a_search_hands_its_world_to_its_start(key):
    config = preset("smoke")
    sizes = {"population_size": 12, "num_elites": 2, "num_finalists": 0}
    env = make_env(config.train.env)
    es = make_strategy(dataclasses.replace(config, start="graded", **sizes), env)
    first = jax.jit(es.ask)(key, es.init())
    places = jax.jit(lambda key: typical_lidars(env, key))(jax.random.key(0))
    costs = jax.jit(jax.vmap(intrinsic_cost, (0, None)))(first, places)
    quiet = 100 * np.mean(np.asarray(costs) < QUIET_COST, axis=1)
    assert quiet.min() > QUIET_PLACES[0] - 1
    assert quiet.max() < QUIET_PLACES[1] + 1


# A user's own functions ------------------------------------------------------


def test_candidates_may_be_any_pytree(key):
    """Start, mutation and ranking replaced; all of ask, tell and best."""
    config = dataclasses.replace(SMALL, pool_scores=True)

    def start(key):
        w = jax.random.normal(key, (config.population_size, 2, 3))
        return {"w": w, "n": jnp.arange(config.population_size)}

    def vary(key, elites, num):
        del key
        return jax.tree.map(lambda x: jnp.repeat(x[:1], num, axis=0) * 10, elites)

    es = jit_bundle(
        truncation_es(
            config,
            init=start,
            mutate=vary,
            rank=lambda fitness: jnp.argsort(-fitness.cost),  # the worst first
        )
    )
    state = es.init()
    first = es.ask(key, state)
    fitness = make_fitness(range(6), [0.0] * 6)
    state = es.tell(key, state, first, fitness)
    assert state.elites["n"].tolist() == [5, 4]
    later = es.ask(key, state)
    assert later["n"].tolist() == [5, 4, 50, 50, 50, 50]
    np.testing.assert_array_equal(later["w"][2], 10 * first["w"][5])
    pick = best(state, config.population_size, pool_scores=True)
    assert int(pick.candidate["n"]) == 0


def test_another_start_replaces_the_first_candidates_alone(key):
    start = jnp.full((SMALL.population_size, 41), 7.0)
    es = truncation_es(SMALL, init=lambda key: start)
    first = es.ask(key, es.init())
    np.testing.assert_array_equal(first, start)
    fitness = make_fitness([1.0] * len(first), [1.0] * len(first))
    state = es.tell(key, es.init(), first, fitness)
    later = es.ask(key, state)
    assert not bool((later == 7.0).all())


def test_the_order_of_candidates_is_irrelevant(key):
    keys = jax.random.split(key, 4)
    size = 40
    candidates = {"theta": jax.random.normal(keys[0], (size, 3))}
    cost = jnp.maximum(jax.random.normal(keys[1], (size,)), 0.0)  # half of them zero
    cost = cost.at[5].set(jnp.nan)
    fitness = Fitness(cost=cost, ep_return=jax.random.normal(keys[2], (size,)))
    order = jax.random.permutation(keys[3], size)
    elites, index = select(candidates, fitness, 8)
    shuffle = jax.tree.map(lambda x: x[order], (candidates, fitness))
    shuffled, shuffled_index = select(shuffle[0], shuffle[1], 8)
    np.testing.assert_array_equal(elites["theta"], shuffled["theta"])
    np.testing.assert_array_equal(index, order[shuffled_index])


@pytest.mark.parametrize("num_elites", [0, -1, 5])
def test_a_bad_number_of_elites_is_refused(num_elites):
    with pytest.raises(ValueError, match=r"num_elites must be in \[1, 4\]"):
        select(jnp.zeros((4, 2)), make_fitness([0.0] * 4, [0.0] * 4), num_elites)


# Mutation --------------------------------------------------------------------


def test_children_are_dealt_round_robin_in_rank_order(key):
    elites = 1000.0 * jnp.arange(1.0, 4.0)[:, None] * jnp.ones((1, 5))
    children = mutate(key, elites, 8, std=1e-3, low=0.999, high=1.001)
    parents = np.round(np.asarray(children[:, 0]) / 1000.0)
    assert parents.tolist() == [1, 2, 3, 1, 2, 3, 1, 2]


def split_by_kind(key, num_children=2000, size=50, **options):
    """Children of one elite of ones and minus ones, by the mutation they got."""
    sign = jnp.where(jnp.arange(size) % 2 == 0, 1.0, -1.0)
    children = np.asarray(jit_mutate(key, 100.0 * sign[None], num_children, **options))
    ratio = children / (100.0 * np.asarray(sign))
    # Noise of a few units keeps 100 within 20 %; not so 50 factors in [0.5, 2].
    additive = np.abs(ratio - 1.0).max(axis=1) < 0.2
    noise = children[additive] - 100.0 * np.asarray(sign)
    return additive, noise, ratio[~additive]


def test_a_fair_coin_chooses_the_mutation(key):
    additive, _, _ = split_by_kind(key)
    deviation = 0.5 / np.sqrt(additive.size)
    assert abs(additive.mean() - 0.5) < SIGMAS * deviation


@pytest.mark.parametrize("std", [1.0, 3.0])
def test_the_additive_mutation_is_normal(key, std):
    _, noise, _ = split_by_kind(key, std=std)
    assert abs(noise.mean()) < SIGMAS * std / np.sqrt(noise.size)
    assert abs(noise.std() - std) < SIGMAS * std / np.sqrt(2 * noise.size)


def test_the_multiplicative_mutation_is_uniform_and_keeps_signs(key):
    _, _, factors = split_by_kind(key)
    assert factors.min() >= 0.5
    assert factors.max() <= 2.0
    deviation = 1.5 / np.sqrt(12)
    error = SIGMAS * deviation / np.sqrt(factors.size)
    assert abs(factors.mean() - 1.25) < error
    assert abs((factors < 1.25).mean() - 0.5) < SIGMAS * 0.5 / np.sqrt(factors.size)


def test_factors_are_drawn_for_every_entry(key):
    _, _, factors = split_by_kind(key)
    assert (factors.std(axis=1) > 0.1).all()


def test_any_pytree_can_be_mutated(key):
    elites = {"w": jnp.ones((2, 3, 4)), "deep": [jnp.ones(2), (jnp.zeros((2, 1)),)]}
    children = jit_mutate(key, elites, 5)
    assert jax.tree.structure(children) == jax.tree.structure(elites)
    assert [x.shape for x in jax.tree.leaves(children)] == [(5,), (5, 1), (5, 3, 4)]
    assert not np.array_equal(children["w"][0], children["w"][2])


def test_all_elites_leave_no_room_for_children(key):
    config = dataclasses.replace(SMALL, num_elites=6)
    es = truncation_es(config)
    state = es.init().replace(generation=jnp.ones((), jnp.int32))
    assert es.ask(key, state).shape == (6, 41)


# Ask and tell ----------------------------------------------------------------


def tell_once(es, key, state, cost, ep_return):
    candidates = es.ask(key, state)
    return candidates, es.tell(key, state, candidates, make_fitness(cost, ep_return))


def test_generation_zero_is_normal(key):
    config = SearchConfig(init_std=5.0, population_size=500)
    es = truncation_es(config)
    first = np.asarray(es.ask(key, es.init()))
    assert first.shape == (500, 41)
    assert abs(first.mean()) < SIGMAS * 5.0 / np.sqrt(first.size)
    assert abs(first.std() - 5.0) < SIGMAS * 5.0 / np.sqrt(2 * first.size)


def test_ask_is_pure(key):
    es = SMALL_ES
    candidates, state = tell_once(es, key, es.init(), range(6), range(6))
    again = es.ask(key, state)
    np.testing.assert_array_equal(again, es.ask(key, state))
    assert not np.array_equal(again, es.ask(jax.random.key(1), state))
    np.testing.assert_array_equal(candidates, es.ask(key, es.init()))


def test_elites_stay_in_front(key):
    es = SMALL_ES
    cost = [5.0, 1.0, 4.0, 0.0, 3.0, 2.0]
    candidates, state = tell_once(es, key, es.init(), cost, [0.0] * 6)
    following = es.ask(jax.random.key(1), state)
    np.testing.assert_array_equal(following[:2], candidates[jnp.array([3, 1])])
    assert not np.isin(following[2:], candidates).any()


def test_jit_and_vmap(key):
    es = truncation_es(SMALL)
    keys = jax.random.split(key, 3)
    fitness = make_fitness(jnp.arange(6.0), jnp.zeros(6))

    def two_stages(key):
        state = es.init()
        for stage in range(2):
            candidates = es.ask(jax.random.fold_in(key, stage), state)
            state = es.tell(key, state, candidates, fitness)
        return state

    together = jax.jit(jax.vmap(two_stages))(keys)
    alone = two_stages(keys[1])
    for one, many in zip(
        jax.tree.leaves(alone), jax.tree.leaves(together), strict=True
    ):
        np.testing.assert_allclose(one, many[1], rtol=1e-6)  # another program


def test_a_told_state_keeps_its_type(key):
    es = SMALL_ES
    _, state = tell_once(es, key, es.init(), range(6), range(6))
    before, after = jax.tree.leaves(es.init()), jax.tree.leaves(state)
    assert [x.aval for x in before] == [x.aval for x in after]


# The final pick --------------------------------------------------------------


def run_stages(stages, tolerance=0.0):
    """Tell stages of (cost, return) lists; the pick and all candidates [S, P, D]."""
    es, key = SMALL_ES, jax.random.key(0)
    state, told = es.init(), []
    for stage, (cost, ep_return) in enumerate(stages):
        stage_key = jax.random.fold_in(key, stage)
        candidates, state = tell_once(es, stage_key, state, cost, ep_return)
        told.append(candidates)
    return best(state, SMALL.population_size, tolerance), told


def place(pick):
    return int(pick.generation), int(pick.index), bool(pick.zero_violation)


def test_the_pick_is_the_best_zero_of_all_stages():
    costs = [3.0, 2.0, 1.0, 0.0, 5.0, 4.0]
    pick, told = run_stages(
        [
            (costs, [9.0, 9.0, 9.0, 3.0, 9.0, 9.0]),
            (costs, [9.0, 9.0, 9.0, 7.0, 9.0, 9.0]),
            (costs, [9.0, 9.0, 9.0, 5.0, 9.0, 9.0]),
        ]
    )
    assert place(pick) == (1, 3, True)
    assert float(pick.ep_return) == 7.0
    np.testing.assert_array_equal(pick.candidate, told[1][3])


def test_without_a_zero_the_pick_is_the_lowest_cost():
    pick, told = run_stages(
        [
            ([3.0, 2.0, 8.0, 9.0, 9.0, 9.0], [99.0] * 6),
            ([0.5, 2.0, 0.25, 9.0, 9.0, 9.0], [0.0] * 6),
        ]
    )
    assert place(pick) == (1, 2, False)
    assert float(pick.cost) == 0.25
    np.testing.assert_array_equal(pick.candidate, told[1][2])
    tolerant, _ = run_stages(
        [([3.0, 2.0, 8.0, 9.0, 9.0, 9.0], [0.0, 9.0, 0.0, 0.0, 0.0, 0.0])], tolerance=3
    )
    assert place(tolerant) == (0, 1, True)


@pytest.mark.parametrize(("cost", "ep_return"), BROKEN)
def test_a_broken_candidate_is_never_the_pick(cost, ep_return):
    stage = ([cost] * 5 + [1e6], [ep_return] * 5 + [-1e6])
    pick, _ = run_stages([stage, stage])
    assert place(pick) == (0, 5, False)


@pytest.mark.parametrize("whole_stage", [0, 1])
@pytest.mark.parametrize(("cost", "ep_return"), BROKEN)
def test_a_stage_without_survivors_leaves_no_pick(cost, ep_return, whole_stage):
    """Not even of the other stage; a search that was told nothing has none either."""
    stages = [([1.0] * 6, [1.0] * 6)] * 2
    stages[whole_stage] = ([cost] * 6, [ep_return] * 6)
    pick, _ = run_stages(stages)
    untold = best(SMALL_ES.init(), SMALL.population_size)
    for nothing in (pick, untold):
        assert place(nothing) == (-1, -1, False)
        assert np.isnan(nothing.candidate).all()
        assert (float(nothing.cost), float(nothing.ep_return)) == (np.inf, -np.inf)


def test_the_failed_stage_is_the_first_one():
    es, size, key = SMALL_ES, SMALL.population_size, jax.random.key(0)
    state, seen = es.init(), [int(failed_stage(SMALL_ES.init(), size))]
    for cost in (1.0, jnp.inf, jnp.inf):
        told = ([cost] * 5 + [jnp.inf], [0.0] * 6)
        _, state = tell_once(es, key, state, *told)
        seen.append(int(failed_stage(state, size)))
    assert seen == [-1, -1, 1, 1]


# The search as a whole -------------------------------------------------------


def sphere(candidates):
    """A cost that only falls towards the point (1, ..., 1), never zero."""
    cost = jnp.mean((candidates - 1.0) ** 2, axis=-1) + 0.1
    return Fitness(cost=cost, ep_return=jnp.zeros_like(cost))


def mean_cost_of_elites(selection):
    """[S] after each stage."""
    config = SearchConfig(
        population_size=40,
        num_elites=5,
        num_stages=25,
        mutation_std=0.3,
        init_std=3.0,
        selection=selection,
    )
    es, root = truncation_es(config), jax.random.key(0)

    def stage(state, index):
        key_ask, key_tell = jax.random.split(jax.random.fold_in(root, index))
        candidates = es.ask(key_ask, state)
        state = es.tell(key_tell, state, candidates, sphere(candidates))
        return state, jnp.mean(sphere(state.elites).cost)

    _, costs = jax.jit(lambda: jax.lax.scan(stage, es.init(), jnp.arange(25)))()
    return np.asarray(costs)


def test_selection_descends_a_sphere():
    costs = mean_cost_of_elites("paper")
    assert costs[-1] < 0.5 * costs[0]
    assert (np.diff(costs) <= 1e-5).all()  # elites are kept: never worse


def test_random_selection_does_not():
    costs = mean_cost_of_elites("random")
    assert costs[-1] > 0.8 * costs[0]


def test_random_selection_picks_candidates_without_looking(key):
    es = jit_bundle(truncation_es(dataclasses.replace(SMALL, selection="random")))
    candidates = es.ask(key, es.init())
    told = [
        es.tell(key, es.init(), candidates, make_fitness(cost, [0.0] * 6)).elites
        for cost in ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    ]
    np.testing.assert_array_equal(told[0], told[1])
    assert all(any(np.array_equal(e, c) for c in candidates) for e in told[0])
    other = es.tell(
        jax.random.key(1), es.init(), candidates, make_fitness(range(6), [0.0] * 6)
    )
    assert not np.array_equal(other.elites, told[0])
