"""Whole episodes of random actions in every world: nothing may become non-finite."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.config import ENVS, env_config
from autocost_jax.envs.env import make_env

NUM_WORLDS, NUM_STEPS, CHUNK = 256, 1000, 50
SPEED = {"Point": 4.0, "Car": 8.0, "Doggo": 8.0}  # m/s in the plane, never reached
FLOOR = -0.05  # m, lower than any centre of mass can come


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVS)
def test_thousand_random_steps_of_256_worlds(name, record_property):
    """Uniform actions, then ones held for a while: half of the worlds each."""
    env = make_env(env_config(name))
    keys = jax.random.split(jax.random.key(0), NUM_WORLDS)
    state = jax.jit(jax.vmap(env.reset))(keys)

    @jax.jit
    def run(state, key):
        shape = (CHUNK, NUM_WORLDS, env.action_size)
        drawn = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        held = jnp.broadcast_to(drawn[:1], shape)
        actions = jnp.where((jnp.arange(NUM_WORLDS) % 2 == 0)[:, None], drawn, held)

        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            leaves = jax.tree.leaves(state.replace(key=None))
            floats = [
                leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)
            ]
            finite = functools.reduce(
                jnp.logical_and, [jnp.isfinite(x).all() for x in floats]
            )
            velocity = jnp.linalg.norm(state.data.qvel[:, :2], axis=-1)
            lowest = state.data.bodies.robot[:, 2].min()
            return state, (finite, velocity, lowest, state.cost, state.failed)

        return jax.lax.scan(step, state, actions)

    velocities, costs = [], []
    for chunk in range(NUM_STEPS // CHUNK):
        state, (finite, velocity, lowest, cost, failed) = run(
            state, jax.random.fold_in(jax.random.key(1), chunk)
        )
        assert finite.all()
        assert not failed.any()
        assert lowest.min() > FLOOR
        velocities.append(np.asarray(velocity))
        costs.append(np.asarray(cost))
    velocity = np.concatenate(velocities)
    assert velocity.max() < SPEED[env.config.robot]
    assert velocity.mean() > 0.01
    record_property("largest speed", float(velocity.max()))
    record_property("mean cost of a step", float(np.concatenate(costs).mean()))
