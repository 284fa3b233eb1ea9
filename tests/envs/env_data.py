"""Recorded data and compiled environments for the tests of this folder."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.env import Env, make_env
from autocost_jax.records import EnvState, Layout

DATA = Path(__file__).parents[1] / "data"
NUM_WORLDS = 200  # one batch size for all tests, so that each function compiles once

# Safety Gym's own PointGoal1, less its vase.
POINT_GOAL_1 = EnvConfig(
    placements_extents=(-1.5, -1.5, 1.5, 1.5),
    goal_keepout=0.305,
    hazards_size=0.2,
    hazards_keepout=0.18,
    constrain_indicator=True,
    lidar_num_bins=16,
    lidar_max_dist=3.0,
)


class Compiled(NamedTuple):
    """An environment with its functions jitted over `NUM_WORLDS` worlds."""

    env: Env
    reset: Callable[[jax.Array], EnvState]
    reset_to: Callable[[Layout, jax.Array], EnvState]
    step: Callable[[EnvState, jax.Array], EnvState]


def load(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / f"{name}.npz", allow_pickle=False) as file:
        return dict(file)


def float32_bound(closest: np.ndarray) -> np.ndarray:
    """Error allowed of a float32 lidar whose nearest target is `closest` metres away.

    1e-5, plus what rounding positions of order 1 m does to the angle, 2e-7 / closest,
    in units of one of 16 bins.
    """
    return 1e-5 + 5e-7 / closest


def compile_env(config: EnvConfig) -> Compiled:
    env = make_env(config)
    functions = (env.reset, env.reset_to, env.step)
    reset, reset_to, step = (jax.jit(jax.vmap(function)) for function in functions)

    def strong_step(state: EnvState, action: jax.Array) -> EnvState:
        # A weakly typed action would compile a second time.
        return step(state, jnp.asarray(action, state.obs.dtype))

    return Compiled(env, reset, reset_to, strong_step)
