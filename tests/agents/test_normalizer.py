"""Running statistics of observations against numpy over everything at once."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import SIZES, SMALL, act, make_slot, make_trajectory

from autocost_jax.agents.base import actor
from autocost_jax.agents.cpo import cpo
from autocost_jax.agents.normalizer import (
    MAX_ABS,
    MIN_STD,
    init_normalizer,
    normalize_obs,
    update_normalizer,
)
from autocost_jax.agents.ppo_lagrangian import ppo_lagrangian


def test_batches_add_up_to_the_whole(key):
    obs = 3.0 + 5.0 * jax.random.normal(key, (7, 40, 3))
    normalizer = init_normalizer(3)
    for batch in obs:
        normalizer = update_normalizer(normalizer, batch, jnp.ones(40))
    flat = obs.reshape(-1, 3)
    np.testing.assert_allclose(normalizer.mean, flat.mean(0), rtol=1e-5)
    std = np.sqrt(normalizer.square / normalizer.count)
    np.testing.assert_allclose(std, flat.std(0), rtol=1e-5)
    seen = normalize_obs(normalizer, flat)
    np.testing.assert_allclose(seen.mean(0), 0.0, atol=1e-5)
    np.testing.assert_allclose(seen.std(0), 1.0, rtol=1e-4)


def test_rows_without_weight_are_not_seen():
    obs = jnp.array([[1.0], [3.0], [jnp.nan]])
    seen = update_normalizer(init_normalizer(1), obs, jnp.array([1.0, 1.0, 0.0]))
    assert (float(seen.count), float(seen.mean[0]), float(seen.square[0])) == (2, 2, 2)


def test_a_constant_reading_is_not_blown_up():
    """Gravity: 9.81 and a rounding error."""
    obs = jnp.full((100, 1), 9.81)
    normalizer = update_normalizer(init_normalizer(1), obs, jnp.ones(100))
    value = normalize_obs(normalizer, jnp.array([9.81 + 1e-5]))
    assert abs(float(value[0])) < 2e-5 / MIN_STD
    assert float(normalize_obs(normalizer, jnp.array([1e6]))[0]) == MAX_ABS


def test_before_the_first_update_observations_pass():
    obs = jnp.array([0.5, -9.0])
    np.testing.assert_array_equal(normalize_obs(init_normalizer(2), obs), obs)


@pytest.mark.parametrize("make", [ppo_lagrangian, cpo])
def test_an_agent_learns_its_normalizer(make, key):
    config = dataclasses.replace(SMALL, normalize_obs=True)
    agent, plain = make(config, SIZES), make(SMALL, SIZES)
    state = jax.jit(agent.init)(key)
    obs, action = act(agent, state, key)
    trajectory = make_trajectory(obs, action, action[..., 0])
    cost = jnp.zeros_like(trajectory.reward)
    after, _ = jax.jit(agent.update)(state, trajectory, cost, make_slot(), key)
    rows = np.asarray(obs[:-1]).reshape(-1, obs.shape[-1])
    np.testing.assert_allclose(after.normalizer.mean, rows.mean(0), rtol=1e-4)
    # The same networks act otherwise once observations are normalised.
    before = agent.policy(after.replace(normalizer=state.normalizer), obs, key, True)
    assert not np.allclose(agent.policy(after, obs, key, True), before)
    assert actor(after).normalizer is after.normalizer
    assert plain.init(key).normalizer == ()
