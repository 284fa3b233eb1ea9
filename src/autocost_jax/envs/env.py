"""The environment: physics, task and constraint put together, as pure functions."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from mujoco import mjx

from autocost_jax.config import LIDAR_BINS, EnvConfig
from autocost_jax.envs import layout as layouts
from autocost_jax.envs.constraints import Constraint, distances_to, hazard_constraint
from autocost_jax.envs.sensors import flatten, lidar, slices
from autocost_jax.envs.tasks import Task, goal_task
from autocost_jax.envs.world import World, make_world
from autocost_jax.records import CostInputs, EnvState, Key, Layout

_CONFIGS = {config.name: config for config in (EnvConfig(),)}


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
      mj_model: the robot's `mujoco.MjModel`; None where there is none.
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


def list_envs() -> list[str]:
    """Names that `make_env` knows."""
    return list(_CONFIGS)


def make_env(name_or_config: str | EnvConfig) -> Env:
    """The environment of a name, or of a configuration.

    Raises:
      ValueError: if the name is unknown, or if the configuration's objects fail to
        fit in more than 5 % of 256 trial layouts.
    """
    if isinstance(name_or_config, EnvConfig):
        config = name_or_config
    elif name_or_config in _CONFIGS:
        config = _CONFIGS[name_or_config]
    else:
        known = ", ".join(list_envs())
        raise ValueError(f"unknown environment {name_or_config!r}; known: {known}")
    parts = _Parts(
        config=config,
        arena=layouts.make_arena(config),
        world=make_world(config),
        task=goal_task(config),
        constraint=hazard_constraint(config),
    )
    world = parts.world
    lidar_names = (*parts.task.lidars, parts.constraint.lidar_name)
    lidar_sizes = dict.fromkeys(lidar_names, config.lidar_num_bins)
    obs_slices = slices({**world.sensor_sizes, **lidar_sizes})
    return Env(
        reset=functools.partial(_reset, parts),
        reset_to=functools.partial(_reset_to, parts),
        step=functools.partial(_step, parts),
        observation_size=max(part.stop for part in obs_slices.values()),
        action_size=world.action_size,
        episode_length=config.num_steps,
        dt=world.dt,
        obs_slices=MappingProxyType(obs_slices),
        config=config,
        mj_model=world.mj_model,
    )


def _reset(parts: _Parts, key: Key) -> EnvState:
    key_layout, key_state = jax.random.split(key)
    dtype = parts.world.dtype
    layout, failed = layouts.sample_layout(parts.arena, key_layout, dtype)
    state = _reset_to(parts, layout, key_state)
    return _silence(state, state, failed)


def _reset_to(parts: _Parts, layout: Layout, key: Key) -> EnvState:
    """The first state of an episode in a given layout.

    Raises:
      AssertionError: while tracing, if the layout has another number of hazards than
        the configuration.
    """
    chex.assert_shape(layout.hazards, (parts.config.hazards_num, 2))
    chex.assert_shape(layout.pillars, (0, 2))
    dtype = parts.world.dtype
    layout = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), layout)
    data = parts.world.place(layout)
    layout = _update_layout(parts, layout, data)
    zero = jnp.zeros((), dtype)
    obs, constraint_lidar = _observe(parts, layout, data)
    distance = distances_to(parts.constraint, layout).min()
    state = EnvState(
        data=data,
        layout=layout,
        obs=obs,
        reward=zero,
        cost=zero,
        done=jnp.zeros((), bool),
        failed=jnp.zeros((), bool),
        age=jnp.zeros((), jnp.int32),
        task_distances=parts.task.distances(layout),
        cost_inputs=CostInputs(
            cost=zero,
            constraint_lidar=constraint_lidar,
            distance=distance,
            previous_distance=distance,
            radius=jnp.full((), parts.constraint.radius, dtype),
        ),
        metrics={
            "goals_met": jnp.zeros((), jnp.int32),
            "goal_move_failures": jnp.zeros((), jnp.int32),
            "distance_travelled": zero,
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
    data = parts.world.control_step(state.data, action)
    layout = _update_layout(parts, state.layout, data)

    # Judged before the goal moves.
    current = task.distances(layout)
    is_met = task.is_met(current)
    reward = task.reward(state.task_distances, current)
    reward = reward + jnp.where(is_met, config.reward_goal, 0.0)
    distances = distances_to(constraint, layout)
    cost = constraint.cost(distances)

    # Drawn whether or not it is needed: under vmap a condition would run both ways.
    age = state.age + 1
    key_move = jax.random.fold_in(state.key, age)  # one key per step of the episode
    goal_xy, is_valid = layouts.move_goal(parts.arena, layout, key_move)
    goal_xy = jnp.where(is_met, goal_xy, layout.goal_xy)
    layout = layout.replace(goal_xy=goal_xy)

    obs, constraint_lidar = _observe(parts, layout, data)
    travelled = layout.robot_xy - parts.world.robot_xy(state.data)
    counters = state.metrics
    new_state = state.replace(
        data=data,
        layout=layout,
        obs=obs,
        reward=reward,
        cost=cost,
        done=age == config.num_steps,
        age=age,
        task_distances=task.distances(layout),
        cost_inputs=CostInputs(
            cost=cost,
            constraint_lidar=constraint_lidar,
            distance=distances.min(),
            previous_distance=state.cost_inputs.distance,
            radius=state.cost_inputs.radius,
        ),
        metrics={
            "goals_met": counters["goals_met"] + is_met,
            "goal_move_failures": counters["goal_move_failures"] + (is_met & ~is_valid),
            "distance_travelled": counters["distance_travelled"]
            + jnp.sqrt((travelled**2).sum()),
        },
    )
    return _silence(state, new_state, state.failed | ~_is_finite(new_state))


def _update_layout(parts: _Parts, layout: Layout, data: mjx.Data) -> Layout:
    """The layout with the robot where the physics has it now."""
    position, rotation = parts.world.robot_pose(data)
    yaw = jnp.arctan2(rotation[1, 0], rotation[0, 0])
    return layout.replace(robot_xy=position[:2], robot_yaw=yaw)


def _observe(
    parts: _Parts, layout: Layout, data: mjx.Data
) -> tuple[jax.Array, jax.Array]:
    """The flat observation [O] and the 8-bin lidar [B] of the constraint's objects."""
    config, constraint = parts.config, parts.constraint
    position, rotation = parts.world.robot_pose(data)
    see = functools.partial(
        lidar,
        position=position,
        rotation=rotation,
        num_bins=config.lidar_num_bins,
        max_dist=config.lidar_max_dist,
        exp_gain=config.lidar_exp_gain,
        alias=config.lidar_alias,
    )
    objects = constraint.objects(layout)
    seen = see(objects)
    obs = {name: see(targets(layout)) for name, targets in parts.task.lidars.items()}
    obs |= {constraint.lidar_name: seen, **parts.world.sensors(data)}
    # What the intrinsic cost reads does not depend on what the robot observes.
    observed = (
        config.lidar_num_bins,
        config.lidar_max_dist,
        config.lidar_exp_gain,
        config.lidar_alias,
    )
    if observed != (LIDAR_BINS, None, 1.0, True):
        seen = lidar(objects, position, rotation, num_bins=LIDAR_BINS)
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
        return jnp.where(failed, old, new)

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
