"""Tasks: which distances count, what they are worth, when the goal is met."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.config import EnvConfig
from autocost_jax.records import Layout


class Task(NamedTuple):
    """What the robot is asked to do, as pure functions of where things stand.

    Attributes:
      distances: layout -> [M] distances that the reward follows, metres.
      reward: (previous, current distances) -> [] dense reward.
      is_met: current distances -> [] bool, whether the goal is reached.
      lidars: name of each lidar -> (layout -> [n, 2] positions it sees).
    """

    distances: Callable[[Layout], jax.Array]
    reward: Callable[[jax.Array, jax.Array], jax.Array]
    is_met: Callable[[jax.Array], jax.Array]
    lidars: Mapping[str, Callable[[Layout], jax.Array]]


def goal_task(config: EnvConfig) -> Task:
    """Drive to the goal, again and again: one planar distance, robot to goal.

        reward = clip(reward_distance (d' - d), +-reward_clip),   met = d <= goal_size

    Source: openai/safety-gym engine.py, reward and goal_met for task "goal".
    """
    clip = config.reward_clip

    def distances(layout: Layout) -> jax.Array:
        return jnp.linalg.norm(layout.robot_xy - layout.goal_xy)[None]

    def reward(previous: jax.Array, current: jax.Array) -> jax.Array:
        gain = config.reward_distance * (previous - current).sum()
        return jnp.clip(gain, -clip, clip)

    def is_met(current: jax.Array) -> jax.Array:
        return current[0] <= config.goal_size

    def goal(layout: Layout) -> jax.Array:
        return layout.goal_xy[None]

    return Task(distances, reward, is_met, {"goal_lidar": goal})
