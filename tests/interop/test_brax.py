"""Brax sees our environment as one of its own."""

import jax
import numpy as np
import pytest

from autocost_jax import EnvConfig, make_env
from autocost_jax.interop.brax import BraxEnv


@pytest.fixture(scope="module")
def env():
    return make_env(EnvConfig(num_steps=5, physics="closed_form"))


def test_steps_like_the_env_underneath(env):
    brax_env = BraxEnv(env)
    key = jax.random.key(3)
    state, plain = jax.jit(brax_env.reset)(key), jax.jit(env.reset)(key)
    step, plain_step = jax.jit(brax_env.step), jax.jit(env.step)
    action = np.asarray([0.3, -0.8], np.float32)
    for t in range(5):
        state, plain = step(state, action), plain_step(plain, action)
        np.testing.assert_array_equal(state.obs, plain.obs)
        np.testing.assert_array_equal(state.reward, plain.reward)
        np.testing.assert_array_equal(state.info["cost"], plain.cost)
        assert float(state.done) == float(t == 4)


def test_brax_wrappers_run_episodes_on_it(env):
    from brax.envs.wrappers.training import wrap

    wrapped = wrap(BraxEnv(env), episode_length=5)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    state = jax.jit(wrapped.reset)(keys)
    step = jax.jit(wrapped.step)
    dones = []
    for _ in range(6):
        state = step(state, np.zeros((2, 2), np.float32))
        dones.append(np.asarray(state.done))
    assert np.asarray(dones)[4].all()
    assert not np.asarray(dones)[5].any()  # reset by the wrapper
    assert brax_sizes(wrapped) == (env.observation_size, env.action_size)


def brax_sizes(env) -> tuple[int, int]:
    return env.observation_size, env.action_size
