"""Compiled environments, shared by the tests of this folder."""

import jax
import numpy as np
import pytest
from env_data import NUM_WORLDS, Compiled, compile_env, load

from autocost_jax.config import EnvConfig, env_config
from autocost_jax.records import EnvState


@pytest.fixture(scope="session")
def default_env() -> Compiled:
    return compile_env(EnvConfig())


@pytest.fixture(scope="session")
def point_goal_1() -> Compiled:
    """Safety Gym's own PointGoal1, with its vase."""
    return compile_env(env_config("PointGoal1"))


@pytest.fixture(scope="session")
def worlds(default_env: Compiled) -> EnvState:
    """`NUM_WORLDS` fresh worlds of the default environment."""
    return default_env.reset(jax.random.split(jax.random.key(0), NUM_WORLDS))


@pytest.fixture(scope="session")
def free_point() -> dict[str, np.ndarray]:
    return load("free_point_smooth")
