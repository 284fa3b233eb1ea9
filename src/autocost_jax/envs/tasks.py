"""Tasks: which distances count, what they are worth, when the goal is met."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.config import EnvConfig
from autocost_jax.records import Bodies, Layout


class Task(NamedTuple):
    """What the robot is asked to do, as pure functions of where things stand.

    Attributes:
      distances: (layout, bodies) -> [M] distances that the reward follows, metres.
      reward: (previous, current distances) -> [] dense reward.
      is_met: current distances -> [] bool, whether the goal is reached.
      lidars: name of each lidar -> (layout -> [M, 2] positions it sees).
    """

    distances: Callable[[Layout, Bodies], jax.Array]
    reward: Callable[[jax.Array, jax.Array], jax.Array]
    is_met: Callable[[jax.Array], jax.Array]
    lidars: Mapping[str, Callable[[Layout], jax.Array]]


def make_task(config: EnvConfig) -> Task:
    """The task that a configuration names."""
    return {"Goal": goal_task, "Push": push_task}[config.task](config)


def goal_task(config: EnvConfig) -> Task:
    """Drive to the goal, again and again: one planar distance, robot to goal.

        reward = clip(reward_distance (d' - d), +-reward_clip),   met = d <= goal_size

    Source: openai/safety-gym engine.py, reward and goal_met for task "goal".
    """
    clip = config.reward_clip

    def distances(layout: Layout, bodies: Bodies) -> jax.Array:
        del bodies
        return jnp.linalg.norm(layout.robot_xy - layout.goal_xy)[None]

    def reward(previous: jax.Array, current: jax.Array) -> jax.Array:
        gain = config.reward_distance * (previous - current).sum()
        return jnp.clip(gain, -clip, clip)

    def is_met(current: jax.Array) -> jax.Array:
        return current[0] <= config.goal_size

    return Task(distances, reward, is_met, {"goal_lidar": _goal})


def push_task(config: EnvConfig) -> Task:
    """Push the box to the goal: distances robot to box (b) and box to goal (g).

        reward = clip(reward_box_dist gate (b' - b) + reward_box_goal (g' - g), +-clip)
        gate   = 1[b' > box_null_dist box_size],   met = g <= goal_size

    Source: openai/safety-gym engine.py, reward, dist_box, dist_box_goal, goal_met for
    task "push". Both distances are norms in 3-D, although the engine's comments call
    them planar; AutoCost's text says robot to *goal* for b, most likely a slip.
    """
    clip = config.reward_clip
    near = config.box_null_dist * config.box_size
    goal_z = goal_height(config)

    def distances(layout: Layout, bodies: Bodies) -> jax.Array:
        goal = jnp.append(layout.goal_xy, goal_z)
        to_box, to_goal = bodies.robot - bodies.box, bodies.box - goal
        return jnp.sqrt((jnp.stack([to_box, to_goal]) ** 2).sum(-1))

    def reward(previous: jax.Array, current: jax.Array) -> jax.Array:
        gain = previous - current
        to_box = jnp.where(previous[0] > near, config.reward_box_dist * gain[0], 0.0)
        return jnp.clip(to_box + config.reward_box_goal * gain[1], -clip, clip)

    def is_met(current: jax.Array) -> jax.Array:
        return current[1] <= config.goal_size

    def box(layout: Layout) -> jax.Array:
        return layout.box_xy[None]

    return Task(distances, reward, is_met, {"goal_lidar": _goal, "box_lidar": box})


def goal_height(config: EnvConfig) -> float:
    """Height of the goal's centre, metres; it counts in the distances of Push.

    Source: openai/safety-gym engine.py, build_world_config.
    """
    return config.goal_size / 2 + 0.01


def _goal(layout: Layout) -> jax.Array:
    return layout.goal_xy[None]
