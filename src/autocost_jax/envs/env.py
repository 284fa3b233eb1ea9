"""The environment: physics, task and constraint put together, as pure functions."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import ENVS, LIDAR_BINS, EnvConfig, env_config
from autocost_jax.envs import layout as layouts
from autocost_jax.envs.constraints import Constraint, distances_to, make_constraint
from autocost_jax.envs.physics.closed_form import make_closed_form_world
from autocost_jax.envs.physics.world import World, make_world
from autocost_jax.envs.sensors import flatten, lidar, slices
from autocost_jax.envs.tasks import Task, make_task
from autocost_jax.precision import full_precision
from autocost_jax.records import (
    Bodies,
    CostInputs,
    EnvState,
    Key,
    Layout,
    PhysicsState,
)


@dataclass(frozen=True, eq=False)
class Env:
    """A world to act in: pure functions and the static facts about them.

    Attributes:
      reset: key -> state in a fresh random layout; the key is consumed.
      reset_to: (layout, key) -> state in that layout; the key is consumed and only
        serves later goal moves.
      step: (state, action [U]) -> state one control period later.
      observation_size: O.
      action_size: U; actions are clipped to [-1, 1].
      episode_length: steps until `done`.
      dt: seconds of a step.
      obs_slices: name of each part of the observation -> its slice.
      config: the configuration it was made from.
      mj_model: the `mujoco.MjModel` that is stepped; None where there is none.
    """

    reset: Callable[[Key], EnvState]
    reset_to: Callable[[Layout, Key], EnvState]
    step: Callable[[EnvState, jax.Array], EnvState]
    observation_size: int
    action_size: int
    episode_length: int
    dt: float
    obs_slices: Mapping[str, slice]
    config: EnvConfig
    mj_model: Any = None


class _Parts(NamedTuple):
    """What an environment is made of; static."""

    config: EnvConfig
    world: World
    arena: layouts.Arena
    task: Task
    constraint: Constraint
    observed: tuple[str, ...]


def list_envs() -> list[str]:
    """Names of this project's worlds; `make_env` also knows Safety Gym's suite."""
    return list(ENVS)


def make_env(name_or_config: str | EnvConfig) -> Env:
    """The environment of a name, or of a configuration.

    Args:
      name_or_config: such as "Push-Pillar-Car"; or of Safety Gym's own suite, such as
        "CarPush2"; or an `EnvConfig`.

    Raises:
      ValueError: if the name is unknown, or if the configuration's objects fail to
        fit in more than 5 % of 256 trial layouts.
    """
    config = name_or_config
    if isinstance(config, str):
        config = env_config(config)
    parts = _Parts(
        config=config,
        arena=layouts.make_arena(config),
        world=make_physics(config),
        task=make_task(config),
        constraint=make_constraint(config),
        observed=_observed_kinds(config),
    )
    world = parts.world
    lidar_names = (*parts.task.lidars, *(f"{kind}_lidar" for kind in parts.observed))
    lidar_sizes = dict.fromkeys(lidar_names, config.lidar_num_bins)
    obs_slices = slices({**world.sensor_sizes, **lidar_sizes})
    return Env(
        reset=full_precision(functools.partial(_reset, parts)),
        reset_to=full_precision(functools.partial(_reset_to, parts)),
        step=full_precision(functools.partial(_step, parts)),
        observation_size=max(part.stop for part in obs_slices.values()),
        action_size=world.action_size,
        episode_length=config.num_steps,
        dt=world.dt,
        obs_slices=MappingProxyType(obs_slices),
        config=config,
        mj_model=world.mj_model,
    )


def make_physics(config: EnvConfig) -> World:
    """The physics of a configuration, without task, lidars and cost."""
    make = make_closed_form_world if config.physics == "closed_form" else make_world
    return make(config)


def _observed_kinds(config: EnvConfig) -> tuple[str, ...]:
    """The fields of a `Layout` that a lidar of their own sees."""
    kinds = ("hazards", "vases", "pillars")
    return tuple(kind for kind in kinds if getattr(config, f"observe_{kind}"))


def _reset(parts: _Parts, key: Key) -> EnvState:
    key_layout, key_state = jax.random.split(key)
    dtype = parts.world.dtype
    layout, failed = layouts.sample_layout(parts.arena, key_layout, dtype)
    state = _reset_to(parts, layout, key_state)
    return _silence(state, state, failed)


def _reset_to(parts: _Parts, layout: Layout, key: Key) -> EnvState:
    """The first state of an episode in a given layout.

    Raises:
      AssertionError: while tracing, if the layout has another number of objects than
        the configuration.
    """
    config = parts.config
    if config.vases_num == 0:
        layout = layout.replace(vases=None, vases_yaw=None)
    for kind in ("hazards", "vases", "pillars"):
        shape = (getattr(config, f"{kind}_num"), 2)
        chex.assert_shape(_objects(layout, kind), shape)
    dtype = parts.world.dtype
    layout = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), layout)
    data = parts.world.place(layout)
    layout = _update_layout(parts, layout, data.bodies)
    zero = jnp.zeros((), dtype)
    obs, constraint_lidar = _observe(parts, layout, data)
    distance, radius = _closest(parts.constraint, layout)
    state = EnvState(
        data=data,
        layout=layout,
        obs=obs,
        reward=zero,
        cost=zero,
        done=jnp.zeros((), bool),
        failed=jnp.zeros((), bool),
        age=jnp.zeros((), jnp.int32),
        task_distances=parts.task.distances(layout, data.bodies),
        cost_inputs=CostInputs(
            cost=zero,
            constraint_lidar=constraint_lidar,
            distance=distance,
            previous_distance=distance,
            radius=radius,
        ),
        metrics={
            "goals_met": jnp.zeros((), jnp.int32),
            "goal_move_failures": jnp.zeros((), jnp.int32),
            "distance_travelled": zero,
            "steps_outside": jnp.zeros((), jnp.int32),
        },
        key=key,
    )
    return _silence(state, state, ~_is_finite(state))


def _step(parts: _Parts, state: EnvState, action: jax.Array) -> EnvState:
    """One control period: move, judge the new state, then perhaps move the goal.

    Args:
      parts: what the environment is made of.
      state: one world; physics is read from `state.data`, the distances that the
        reward starts from out of `state.task_distances`.
      action: [U], clipped to [-1, 1].

    Returns:
      the next state, of the same type. A step never resets, also not past the end of
      the episode; a world that meets a non-finite number is `failed` from then on: its
      obs, reward, cost and cost inputs are zero, its counters and layout stand still.

    Source: openai/safety-gym engine.py, step.
    """
    config, task, constraint = parts.config, parts.task, parts.constraint
    chex.assert_shape(action, (parts.world.action_size,))
    data = parts.world.control_step(state.data, state.layout, action)
    layout = _update_layout(parts, state.layout, data.bodies)

    # Judged before the goal moves.
    current = task.distances(layout, data.bodies)
    is_met = task.is_met(current)
    reward = task.reward(state.task_distances, current)
    reward = reward + jnp.where(is_met, config.reward_goal, 0.0)
    cost = constraint.cost(distances_to(constraint, layout), data.bodies)
    distance, radius = _closest(constraint, layout)

    # Drawn whether or not it is needed: under vmap a condition would run both ways.
    age = state.age + 1
    key_move = jax.random.fold_in(state.key, age)  # one key per step of the episode
    goal_xy, is_valid = layouts.move_goal(parts.arena, layout, key_move)
    goal_xy = jnp.where(is_met, goal_xy, layout.goal_xy)
    layout = layout.replace(goal_xy=goal_xy)

    obs, constraint_lidar = _observe(parts, layout, data)
    travelled = layout.robot_xy - state.data.qpos[:2]
    counters = state.metrics
    new_state = state.replace(
        data=data,
        layout=layout,
        obs=obs,
        reward=reward,
        cost=cost,
        done=age == config.num_steps,
        age=age,
        task_distances=task.distances(layout, data.bodies),
        cost_inputs=CostInputs(
            cost=cost,
            constraint_lidar=constraint_lidar,
            distance=distance,
            previous_distance=state.cost_inputs.distance,
            radius=radius,
        ),
        metrics={
            "goals_met": counters["goals_met"] + is_met,
            "goal_move_failures": counters["goal_move_failures"] + (is_met & ~is_valid),
            "distance_travelled": counters["distance_travelled"]
            + jnp.sqrt((travelled**2).sum()),
            "steps_outside": counters["steps_outside"] + is_outside(config, layout),
        },
    )
    return _silence(state, new_state, state.failed | ~_is_finite(new_state))


def _update_layout(parts: _Parts, layout: Layout, bodies: Bodies) -> Layout:
    """The layout with robot, box and vases where the physics has them now."""
    rotation = bodies.rotation
    layout = layout.replace(
        robot_xy=bodies.robot[:2],
        robot_yaw=jnp.arctan2(rotation[1, 0], rotation[0, 0]),
    )
    if parts.config.task == "Push":
        layout = layout.replace(box_xy=bodies.box[:2], box_yaw=bodies.box_yaw)
    if bodies.vases is not None:
        vases = bodies.vases[:, :2]
        layout = layout.replace(vases=vases, vases_yaw=bodies.vases_yaw)
    return layout


def is_outside(config: EnvConfig, layout: Layout) -> jax.Array:
    """[] whether the robot's origin is outside the arena that things are placed in."""
    low, high = np.split(np.asarray(config.placements_extents), 2)
    return ((layout.robot_xy < low) | (layout.robot_xy > high)).any()


def _objects(layout: Layout, kind: str) -> jax.Array:
    """[M, 2] centres of a kind of object."""
    positions = getattr(layout, kind)
    return jnp.zeros((0, 2)) if positions is None else positions


def _closest(constraint: Constraint, layout: Layout) -> tuple[jax.Array, jax.Array]:
    """Distance [] to the closest constrained object's centre, and its radius []."""
    distances = distances_to(constraint, layout)
    radii = jnp.asarray(constraint.radii, distances.dtype)
    if len(np.unique(constraint.radii)) == 1:
        return distances.min(), radii[0]
    index = distances.argmin()
    return distances[index], radii[index]


def _observe(
    parts: _Parts, layout: Layout, data: PhysicsState
) -> tuple[jax.Array, jax.Array]:
    """The flat observation [O] and the 8-bin lidar [B] of the constrained objects."""
    config, constraint = parts.config, parts.constraint
    position, rotation = data.bodies.robot, data.bodies.rotation
    see = functools.partial(
        lidar,
        position=position,
        rotation=rotation,
        num_bins=config.lidar_num_bins,
        max_dist=config.lidar_max_dist,
        exp_gain=config.lidar_exp_gain,
        alias=config.lidar_alias,
    )
    obs = {name: see(targets(layout)) for name, targets in parts.task.lidars.items()}
    obs |= {f"{kind}_lidar": see(_objects(layout, kind)) for kind in parts.observed}
    obs |= parts.world.sensors(data)
    # What the intrinsic cost reads does not depend on what the robot observes; where
    # the two are the same the compiler computes them once.
    seen = lidar(constraint.objects(layout), position, rotation, num_bins=LIDAR_BINS)
    return flatten(obs), seen


def _is_finite(state: EnvState) -> jax.Array:
    """[] whether physics, observation, reward and cost are all finite."""
    values = (state.data.qpos, state.data.qvel, state.obs, state.reward, state.cost)
    return functools.reduce(jnp.logical_and, [jnp.isfinite(x).all() for x in values])


def _silence(previous: EnvState, state: EnvState, failed: jax.Array) -> EnvState:
    """`state` where `failed` is False; else zeros, and counters as they were."""

    def zero_if_failed(value: jax.Array) -> jax.Array:
        return jnp.where(failed, jnp.zeros_like(value), value)

    def keep_if_failed(old: jax.Array, new: jax.Array) -> jax.Array:
        # jaxlib 0.11 crashes where it partitions an empty `where` over CPU devices.
        return jnp.where(failed, old, new) if new.size else new

    def keep(old: Any, new: Any) -> Any:
        return jax.tree.map(keep_if_failed, old, new)

    inputs = jax.tree.map(zero_if_failed, state.cost_inputs)
    return state.replace(
        layout=keep(previous.layout, state.layout),
        obs=zero_if_failed(state.obs),
        reward=zero_if_failed(state.reward),
        cost=zero_if_failed(state.cost),
        failed=failed,
        task_distances=keep(previous.task_distances, state.task_distances),
        cost_inputs=inputs.replace(radius=state.cost_inputs.radius),
        metrics=keep(previous.metrics, state.metrics),
    )
