"""Rollouts and cohorts on the toy environment: shapes, alignment, keys, ages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.rollout import (
    carry_cohorts,
    join_cohorts,
    reset_worlds,
    unroll,
)
from autocost_jax.train import init_learner, run_epoch, start_epochs
from toys import NUM_STEPS, RADIUS, intrinsic_slots, linear_agent, make_toy_env
from toys import train_config as make_config

NUM_WORLDS = 3
ROUNDING = 1e-6  # the same formula stepped in another program


def policy(obs, key):
    """Towards the goal, with noise: any two keys act differently."""
    return obs[..., 2:4] + 0.5 * jax.random.normal(key, (*obs.shape[:-1], 2))


@pytest.fixture(scope="module")
def env():
    return make_toy_env()


@pytest.fixture(scope="module")
def roll(env):
    """(reset key, action key) -> worlds at the start, at the end, and trajectory."""

    def run(key_reset, key_act):
        worlds = reset_worlds(env, key_reset, NUM_WORLDS)
        return worlds, *unroll(env, policy, worlds, key_act, NUM_STEPS)

    return jax.jit(run)


@pytest.fixture(scope="module")
def rolled(roll):
    return roll(jax.random.key(1), jax.random.key(2))


def test_shapes(env, rolled):
    start, _, trajectory = rolled
    steps = (NUM_STEPS, NUM_WORLDS)
    assert start.obs.shape == (NUM_WORLDS, env.observation_size)
    assert trajectory.obs.shape == (NUM_STEPS + 1, NUM_WORLDS, env.observation_size)
    assert trajectory.action.shape == (*steps, 2)
    assert trajectory.reward.shape == trajectory.valid.shape == steps
    assert trajectory.cost_inputs.cost.shape == steps
    assert trajectory.cost_inputs.constraint_lidar.shape == (*steps, 8)


def test_rows_are_aligned(rolled):
    """obs[t] is what action t saw; reward and cost are of the state after it."""
    start, end, trajectory = rolled
    np.testing.assert_array_equal(trajectory.obs[0], start.obs)
    np.testing.assert_array_equal(trajectory.obs[-1], end.obs)
    seen = jax.vmap(lambda obs, t: policy(obs, jax.random.fold_in(KEY_ACT, t)))(
        trajectory.obs[:-1], jnp.arange(NUM_STEPS)
    )
    np.testing.assert_allclose(trajectory.action, seen, atol=ROUNDING)
    distance = np.linalg.norm(trajectory.obs[..., 2:4], axis=-1)
    np.testing.assert_allclose(
        trajectory.reward, distance[:-1] - distance[1:], atol=ROUNDING
    )
    inputs = trajectory.cost_inputs
    np.testing.assert_allclose(
        inputs.cost, np.maximum(RADIUS - distance[1:], 0.0), atol=ROUNDING
    )
    np.testing.assert_allclose(inputs.distance, distance[1:], atol=ROUNDING)
    np.testing.assert_allclose(inputs.previous_distance, distance[:-1], atol=ROUNDING)


KEY_ACT = jax.random.key(2)


def test_worlds_start_apart(rolled):
    start, _, _ = rolled
    assert len(np.unique(np.asarray(start.layout.robot_xy), axis=0)) == NUM_WORLDS


def test_the_same_keys_give_the_same_trajectory(roll, rolled):
    again = roll(jax.random.key(1), jax.random.key(2))
    for one, two in zip(
        jax.tree.leaves(again[2]), jax.tree.leaves(rolled[2]), strict=True
    ):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("keys", [(9, 2), (1, 9)])
def test_another_key_gives_another_trajectory(roll, rolled, keys):
    other = roll(*map(jax.random.key, keys))[2]
    same_start = keys[0] == 1
    assert np.array_equal(other.obs[0], rolled[2].obs[0]) == same_start
    assert not np.array_equal(other.action, rolled[2].action)


def test_a_failed_world_stays_invalid():
    """World by world: 1 before it breaks, 0 from that step on, others untouched."""
    limit = 0.5
    env = make_toy_env(fails=lambda layout, age: layout.robot_xy[0] > limit)
    worlds = reset_worlds(env, jax.random.key(1), 16)
    _, trajectory = jax.jit(lambda w: unroll(env, policy, w, KEY_ACT, NUM_STEPS))(
        worlds
    )
    valid = np.asarray(trajectory.valid)
    assert (np.diff(valid, axis=0) <= 0).all()
    fate = set(valid.sum(axis=0))
    assert {0, NUM_STEPS} < fate  # some at once, some never, some in between
    dead = valid == 0
    assert (np.asarray(trajectory.reward)[dead] == 0).all()
    x = np.asarray(trajectory.obs)[:-1, :, 0]
    alive_before = np.vstack([np.ones((1, 16)), valid[:-1]]) > 0
    np.testing.assert_array_equal(alive_before & (x > limit), alive_before & dead)


def test_joining_and_carrying_cohorts():
    worlds = jnp.arange(6.0).reshape(1, 6)
    fresh = jnp.full((1, 2), -1.0)
    carried = carry_cohorts(worlds, 2, 3, axis=1)  # pyright: ignore
    np.testing.assert_array_equal(carried, [[0, 1, 2, 3]])  # pyright: ignore
    joined = join_cohorts(fresh, carried, axis=1)  # pyright: ignore
    np.testing.assert_array_equal(joined, [[-1, -1, 0, 1, 2, 3]])  # pyright: ignore
    assert carry_cohorts(worlds, 2, 1, axis=1) is None  # pyright: ignore
    assert join_cohorts(fresh, None, axis=1) is fresh  # pyright: ignore


@pytest.mark.parametrize("segments", [1, 2, 4])
def test_cohorts_have_true_ages(segments):
    """From the first epoch on one cohort is fresh and each episode is whole."""
    env = make_toy_env()
    agent = linear_agent(env)
    config = make_config(segments_per_episode=segments, num_worlds=2)
    slots = (intrinsic_slots(2),)
    learners = (jax.vmap(lambda slot: init_learner(agent, slot))(slots[0]),)
    epoch_steps = NUM_STEPS // segments

    @jax.jit
    def epochs(learners):
        def body(state, epoch):
            after, metrics = run_epoch(env, (agent,), config, state, slots, epoch)
            return after, (state.worlds, after.worlds, metrics)

        state = start_epochs(env, (agent,), config, learners, slots)
        numbers = jnp.arange(2 * segments, dtype=jnp.int32)
        return jax.lax.scan(body, state, numbers)[1]

    before, after, metrics = epochs(learners)
    assert metrics[0]["ep_return"].shape == (2 * segments, 2)
    if segments == 1:
        assert before is None
        assert after is None
        return
    (before,), (after,) = before, after
    # Carried worlds [E, P, (k - 1) N]: one, two, ... segments old, oldest last.
    ages = epoch_steps * np.repeat(np.arange(1, segments), config.num_worlds)
    assert before.age.shape == (2 * segments, 2, ages.size)
    assert (np.asarray(before.age) == ages).all()
    assert (np.asarray(after.age) == ages).all()
    # The same episode, one cohort further back each epoch: its goal has not moved.
    goals = np.asarray(after.layout.goal_xy)
    for epoch in range(1, 2 * segments):
        np.testing.assert_array_equal(
            goals[epoch, :, config.num_worlds :],
            goals[epoch - 1, :, : -config.num_worlds],
        )
    fresh = goals[:, :, : config.num_worlds].reshape(-1, 2)
    assert len(np.unique(fresh, axis=0)) == len(fresh)  # a new layout every time
