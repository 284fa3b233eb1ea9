"""Recorded data and compiled environments for the tests of this folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.env import Env, make_env
from autocost_jax.records import EnvState, Layout

DATA = Path(__file__).parents[1] / "data"
NUM_WORLDS = 200  # one batch size for all tests, so that each function compiles once


class Compiled(NamedTuple):
    """An environment with its functions jitted over a batch of worlds."""

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


def blank_layout(config: EnvConfig, **known: Any) -> Layout:
    """A layout with everything at the origin but what is given."""
    fields = {
        "robot_xy": np.zeros(2),
        "robot_yaw": np.zeros(()),
        "goal_xy": np.zeros(2),
        "hazards": np.zeros((config.hazards_num, 2)),
        "pillars": np.zeros((config.pillars_num, 2)),
        "box_xy": np.zeros(2),
        "box_yaw": np.zeros(()),
        "vases": np.zeros((config.vases_num, 2)),
        "vases_yaw": np.zeros(config.vases_num),
    }
    arrays: dict[str, Any] = {
        name: np.asarray(value) for name, value in (fields | known).items()
    }
    return Layout(**arrays)


def stack(tree: Any, num: int) -> Any:
    """`num` copies on a new leading axis."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num, *jnp.shape(x))), tree)


def states_at(env: Env, layout: Layout, qpos: Any, qvel: Any) -> EnvState:
    """States [T] whose physics is `qpos` [T, nq] and `qvel` [T, nv].

    Nothing is evaluated, so that only `step` has to be compiled: what a step does not
    read is zero. The next rewards start from the robot's distance to the goal.
    """
    state: Any = jax.eval_shape(env.reset_to, layout, jax.random.key(0))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.replace(key=None))
    num, dtype = len(qpos), state.obs.dtype
    states = stack(zeros, num)
    layouts = stack(jax.tree.map(lambda x: jnp.asarray(x, dtype), layout), num)
    distance = np.linalg.norm(np.asarray(qpos)[:, :2] - layout.goal_xy, axis=-1)
    return states.replace(
        data=states.data.replace(
            qpos=jnp.asarray(qpos, dtype), qvel=jnp.asarray(qvel, dtype)
        ),
        layout=layouts,
        task_distances=jnp.asarray(distance[:, None], dtype),
        key=jax.random.split(jax.random.key(0), num),
    )
