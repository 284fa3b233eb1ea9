"""One program for all slots: what is equal to what, one trace, any device count."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax import population as population_lib
from autocost_jax.config import Algorithm
from autocost_jax.population import (
    candidate_slots,
    make_agents,
    make_evaluator,
    make_population,
    remake_empty,
    stack_slots,
)
from autocost_jax.train import EpochState, final_episodes, init_learner, run_stage
from toys import (
    TRAIN,
    Counter,
    intrinsic_slots,
    linear_agent,
    make_toy_env,
    train_config,
)

ALGORITHMS = ("ppo_lagrangian", "cpo")
SIZE, MORE = 4, 8  # slots a group
EPOCHS = 3
ONE_UPDATE = 1e-5  # across programs: sums of float32 in another order, one update
DOUBLE = 1e-7  # the same in float64, CPO's solve amplifying 1e-16 by up to 1e6
SINGLE = 1e-5  # metrics are float32 also then
SAME_SIZE = 0.01  # of the program's instruction counts


@pytest.fixture(scope="module")
def counter():
    return Counter()


@pytest.fixture(scope="module")
def program(counter):
    """The population program of both algorithms on the toy environment."""
    env = make_toy_env(counter=counter)
    agents = make_agents(ALGORITHMS, TRAIN, env)
    return make_population(env, agents, TRAIN)


def run(program, slots, state=None, epochs=EPOCHS):
    """Learners and metrics [E, P] of each group after some epochs, as NumPy."""
    state = program.init(slots) if state is None else state
    rows = []
    for epoch in range(epochs):
        state, metrics = program.chunk(state, slots, epoch)
        rows.append(metrics)
    metrics = jax.tree.map(lambda *x: np.concatenate(x), *rows)
    return jax.tree.map(np.asarray, state.learners), metrics


def groups(size=SIZE):
    return (intrinsic_slots(size, seed=0), intrinsic_slots(size, seed=1))


def lanes(result, index):
    """Some slots of a result, learners [P] and metrics [E, P] alike."""
    learners, metrics = result
    return (
        jax.tree.map(lambda x: x[index], learners),
        jax.tree.map(lambda x: x[:, index], metrics),
    )


def assert_same_bits(one, two):
    assert jax.tree.structure(one) == jax.tree.structure(two)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.fixture(scope="module")
def reference(program):
    return run(program, groups())


# Within one program: the same bits ---------------------------------------------


def test_slots_learn_different_things(reference):
    """Without this the equalities below would say nothing."""
    learners, metrics = reference
    for group, rows in zip(learners, metrics, strict=True):
        kernel = jax.tree.leaves(group.agent.policy)[0].reshape(SIZE, -1)
        assert len(np.unique(kernel, axis=0)) == SIZE
        assert len(np.unique(rows["ep_total_cost"][-1])) == SIZE
        assert not group.frozen.any()


def test_the_same_seed_twice(program, reference):
    assert_same_bits(run(program, groups()), reference)


def test_every_epoch_has_random_numbers_of_its_own(program):
    slots = groups()
    first, second = (program.chunk(program.init(slots), slots, at)[1] for at in (0, 1))
    for one, two in zip(first, second, strict=True):
        assert not np.equal(one["ep_total_cost"], two["ep_total_cost"]).any()


def test_permuted_slots(program, reference):
    order = np.array([2, 0, 3, 1])
    permuted = run(program, jax.tree.map(lambda x: x[order], groups()))
    assert_same_bits(permuted, lanes(reference, order))


def poison_theta(slots, learners):
    cost = slots[0].cost
    theta = cost.theta.at[1].set(jnp.nan)
    return (slots[0].replace(cost=cost.replace(theta=theta)), slots[1]), learners


def poison_parameters(slots, learners):
    def poison(learner):
        policy = learner.agent.policy
        log_std = policy["log_std"].at[1].set(jnp.nan)
        agent = learner.agent.replace(policy=policy | {"log_std": log_std})
        return learner.replace(agent=agent)

    return slots, tuple(poison(learner) for learner in learners)


@pytest.mark.parametrize("poison", [poison_theta, poison_parameters])
def test_a_nan_neighbour(program, reference, poison):
    slots, learners = poison(groups(), program.init(groups()).learners)
    sick = run(program, slots, EpochState(learners))
    healthy = np.array([0, 2, 3])
    assert_same_bits(lanes(sick, healthy), lanes(reference, healthy))
    frozen = [group.frozen[1] for group in sick[0]]
    assert frozen == [True, poison is poison_parameters]
    assert sick[0][0].frozen_epoch.tolist() == [-1, 0, -1, -1]
    assert (sick[1][0]["frozen"][:, 1] == 1.0).all()


def test_other_contents_of_the_other_slots(program, reference):
    mixed = jax.tree.map(
        lambda own, other: own.at[1:].set(other[1:]),
        groups(),
        (intrinsic_slots(SIZE, seed=7), intrinsic_slots(SIZE, seed=8)),
    )
    assert_same_bits(lanes(run(program, mixed), 0), lanes(reference, 0))


def test_a_group_does_not_see_the_other(program, reference):
    other = run(program, (groups()[0], intrinsic_slots(SIZE, seed=9)))
    assert_same_bits((other[0][0], other[1][0]), (reference[0][0], reference[1][0]))
    assert not np.array_equal(other[1][1]["ep_return"], reference[1][1]["ep_return"])


# Across programs: one update, rounding apart ------------------------------------


@pytest.fixture(scope="module")
def wide():
    """The same program for twice as many slots: its compilation, and one epoch."""
    env = make_toy_env()
    program = make_population(env, make_agents(ALGORITHMS, TRAIN, env), TRAIN)
    slots = jax.tree.map(
        lambda one, two: jnp.concatenate([one, two]), groups(), groups()[::-1]
    )
    state = program.init(slots)
    text = program.compile(state, slots).as_text()
    return text, run(program, slots, state, epochs=1)


def test_another_population_size(program, wide):
    first = run(program, groups(), epochs=1)
    again = lanes(wide[1], slice(0, SIZE))
    for one, two in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, two, rtol=ONE_UPDATE, atol=ONE_UPDATE)


def count_instructions(text):
    return sum(" = " in line for line in text.splitlines())


def test_the_size_of_the_program_is_not_the_populations(program, wide):
    slots = groups()
    text = program.compile(program.init(slots), slots).as_text()
    count, wide_count = count_instructions(text), count_instructions(wide[0])
    assert count > 1000
    assert abs(wide_count - count) <= SAME_SIZE * count


def test_the_physics_is_traced_once_for_both_algorithms(program, reference, counter):
    del program, reference
    assert counter.steps == 1


# Devices ------------------------------------------------------------------------

SCRIPT = """
import json, re, sys
sys.path.insert(0, {tests!r})
import jax
import numpy as np
from test_population import ALGORITHMS, groups, run
from toys import TRAIN, linear_agent, make_toy_env, train_config
from autocost_jax.files import flatten
from autocost_jax.population import make_agents, make_population

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 8)
jax.config.update("jax_enable_x64", True)
collectives = {{}}
for count in {counts!r}:
    env = make_toy_env()
    if {toy!r}:
        agents = (linear_agent(env), linear_agent(env))
    else:
        agents = make_agents(ALGORITHMS, TRAIN, env)
    program = make_population(env, agents, TRAIN, devices=jax.devices()[:count])
    assert program.num_devices == count
    slots = groups(3)
    state = program.init(slots)
    text = program.compile(state, slots).as_text()
    names = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
    collectives[count] = sorted(set(re.findall(names, text)))
    result = run(program, slots, state, epochs=1)
    np.savez({out!r} + f"/{{count}}.npz", **flatten(result))
if {toy!r}:  # carried worlds have no pillars: an array without elements goes in and out
    config = train_config(segments_per_episode=2)
    program = make_population(env, agents, config, devices=jax.devices()[:2])
    jax.block_until_ready(program.chunk(program.init(slots), slots, 0))
print(json.dumps(collectives))
"""


@pytest.fixture(
    scope="module", params=["toy", pytest.param("real", marks=pytest.mark.slow)]
)
def devices(request, tmp_path_factory):
    """Three slots on 1, 2, 8 (padded) and 3 devices: collectives found, and results.

    The toy agents run on 1 and 2.

    In a process of its own, because a CPU is split into devices once; and without
    LLVM's optimisations, which see neither the partition nor a collective. In
    float64, where rounding stays small also in CPO's step.
    """
    out = tmp_path_factory.mktemp("devices")
    toy = request.param == "toy"
    counts = (1, 2) if toy else (1, 2, 3, 8)
    tests = str(Path(__file__).parent)
    script = SCRIPT.format(tests=tests, out=str(out), toy=toy, counts=counts)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    results = {
        count: dict(np.load(out / f"{count}.npz", allow_pickle=False))
        for count in counts
    }
    return json.loads(done.stdout.splitlines()[-1]), results


def test_devices_do_not_talk(devices):
    collectives, results = devices
    assert collectives == {str(count): [] for count in results}
    assert len(results) > 1


def test_any_number_of_devices_gives_the_same_numbers(devices):
    one = devices[1][1]
    for many in devices[1].values():
        assert one.keys() == many.keys()
        for name, value in one.items():
            assert value.shape == many[name].shape
            atol = DOUBLE if value.dtype == np.float64 else SINGLE
            np.testing.assert_allclose(
                many[name], value, rtol=atol, atol=atol, err_msg=name
            )


def test_the_devices_trained_in_float64(devices):
    kinds = {name: value.dtype for name, value in devices[1][1].items()}
    assert any("/agent/" in name for name in kinds)
    for name, kind in kinds.items():
        if "/agent/" in name and kind.kind == "f":
            assert kind == np.float64, name


def test_arrays_without_elements_are_made_anew():
    """What comes out is not what went in, which jaxlib 0.11 cannot compile."""
    program = jax.make_jaxpr(remake_empty)([jnp.ones(3), jnp.ones((2, 0, 3))]).jaxpr
    full, empty = program.outvars
    assert full is program.invars[0]
    assert empty is not program.invars[1]
    assert empty.aval == program.invars[1].aval


# The face of it -----------------------------------------------------------------


@pytest.mark.slow
def test_cohorts_travel_with_their_learners():
    """In the program as in the plain function; and final episodes are whole ones."""
    env = make_toy_env()
    config = train_config(segments_per_episode=2, num_epochs=EPOCHS)
    agents = make_agents(ALGORITHMS, config, env)
    program = make_population(env, agents, config, final_rounds=3)
    slots = groups()
    state = program.init(slots)
    assert state.worlds is not None
    for worlds in state.worlds:
        assert worlds.age.shape == (SIZE, config.num_worlds)
        assert (np.asarray(worlds.age) == config.epoch_steps).all()

    @jax.jit
    def whole(slots):
        first = tuple(
            jax.vmap(lambda slot, agent=agent: init_learner(agent, slot))(group)
            for agent, group in zip(agents, slots, strict=True)
        )
        learners, metrics = run_stage(env, agents, config, first, slots)
        return metrics, final_episodes(env, agents, config, learners, slots, 3)

    expected, expected_final = whole(slots)
    rows = []
    for epoch in range(EPOCHS):
        state, metrics = program.chunk(state, slots, epoch)
        rows.append(metrics)
    final = program.final(state, slots)
    metrics = jax.tree.map(lambda *x: np.concatenate(x), *rows)
    for got, want in ((metrics, expected), (final, expected_final)):
        for group, reference in zip(got, want, strict=True):
            for name in ("ep_cost", "ep_return", "distance_travelled"):
                np.testing.assert_allclose(
                    group[name], reference[name], rtol=1e-2, atol=1e-3, err_msg=name
                )
    assert final[0]["ep_cost"].shape == (3, SIZE)
    assert len(np.unique(final[0]["ep_return"])) == 3 * SIZE  # fresh ones each round


def test_slots_that_learn_side_by_side_learn_the_same(program):
    """As those that learn in turns, a CPU's default."""
    env = make_toy_env()
    config = train_config(population_chunk=SIZE)
    together = make_population(env, make_agents(ALGORITHMS, config, env), config)
    got, expected = (run(each, groups(), epochs=1) for each in (together, program))
    for one, all_ in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, all_, rtol=ONE_UPDATE, atol=ONE_UPDATE)


def test_in_the_last_turn_fewer_slots_learn():
    env = make_toy_env()
    agents = tuple(linear_agent(env) for _ in ALGORITHMS)
    got, expected = (
        run(make_population(env, agents, config), groups(), epochs=1)
        for config in (train_config(population_chunk=3), TRAIN)
    )
    for one, all_ in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, all_, rtol=ONE_UPDATE, atol=ONE_UPDATE)


@pytest.mark.slow
def test_slots_that_learn_in_turns_need_less_memory():
    env = make_toy_env()

    def workspace(chunk):
        config = train_config(population_chunk=chunk)
        population = make_population(env, make_agents(ALGORITHMS, config, env), config)
        slots = groups(MORE)
        compiled = population.compile(population.init(slots), slots)
        return compiled.memory_analysis().temp_size_in_bytes

    assert workspace(1) < 0.9 * workspace(MORE)


def test_a_compiled_program_runs_for_its_own_sizes_alone(caplog):
    """They are not compiled again; other sizes are when they come."""
    env = make_toy_env()
    agents = tuple(linear_agent(env) for _ in ALGORITHMS)
    population = make_population(env, agents, TRAIN)
    population.compile(population.init(groups()), groups())
    for size, compiles in ((MORE, 1), (SIZE, 0)):
        slots = groups(size)
        caplog.clear()
        with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
            state, metrics = population.chunk(population.init(slots), slots, 0)
        lines = [record.getMessage() for record in caplog.records]
        assert sum("Compiling jit(chunk)" in line for line in lines) == compiles
        assert metrics[0]["ep_cost"].shape == (1, size)
        assert len(state.learners[0].frozen) == size


def test_candidates_share_their_random_numbers(key):
    slots = candidate_slots(groups()[0].cost, key)
    assert slots.key.shape == slots.constrained.shape == (SIZE,)
    assert len(np.unique(jax.random.key_data(slots.key), axis=0)) == 1
    assert (slots.constrained == 1.0).all()


def test_stacking_is_undone_by_indexing():
    slots = intrinsic_slots(3)
    parts = [jax.tree.map(lambda x, i=i: x[i], slots) for i in range(3)]
    again = stack_slots(parts)
    np.testing.assert_array_equal(
        jax.random.key_data(again.key), jax.random.key_data(slots.key)
    )
    assert_same_bits(again.cost, slots.cost)


def test_the_evaluator_plays_the_same_layouts_for_all(key, reference):
    env = make_toy_env()
    agent = make_agents(ALGORITHMS[:1], TRAIN, env)[0]
    states = reference[0][0].agent
    run = make_evaluator(env, agent, 5, keep=lambda episodes: episodes)
    result, episodes = run(states, key)
    assert result.ep_return.shape == (SIZE, 5)
    assert episodes.reward.shape == (SIZE, env.episode_length, 5)
    start = np.asarray(episodes.start.robot_xy)
    assert (start == start[:1]).all()
    assert len(np.unique(start[0], axis=0)) == 5
    assert len(np.unique(result.ep_return[:, 0])) == SIZE


def test_an_environment_of_another_length_is_refused_when_the_program_is_built():
    env = make_toy_env(TRAIN.env.num_steps + 1)
    with pytest.raises(ValueError, match=r"episodes of 17 steps.* of 16 \("):
        make_population(env, (linear_agent(env),), TRAIN)


def test_every_algorithm_of_the_configuration_has_its_agent():
    assert set(population_lib.AGENTS) == set(get_args(Algorithm))
