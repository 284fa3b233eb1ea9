"""Whole episodes of a fixed policy on fresh layouts."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from autocost_jax.agents.base import Agent
from autocost_jax.config.checks import COUNT, require
from autocost_jax.envs.env import Env
from autocost_jax.metrics import mean_of
from autocost_jax.records import CostInputs, EnvState, EvalResult, Key, Layout
from autocost_jax.rollout import reset_worlds


class Episodes(struct.PyTreeNode):
    """Whole episodes, step by step; row t is the state after step t, world frame.

    Attributes:
      start: layouts at the start, fields [E, ...].
      reward: [T, E].
      cost_inputs: fields [T, E, ...].
      valid: [T, E] 1.0 until the world fails.
      watched: what `watch` kept, of the start and of every step, leaves [T + 1, ...].
      distance_travelled: [E] path length, metres.
      steps_outside: [E] steps outside the arena.
    """

    start: Layout
    reward: jax.Array
    cost_inputs: CostInputs
    valid: jax.Array
    watched: Any
    distance_travelled: jax.Array
    steps_outside: jax.Array


class Recording(NamedTuple):
    """One episode as arrays; row 0 is the start, row t the state after step t.

    Attributes:
      qpos: [T + 1, nq] positions as in `scene_model`.
      goal_xy: [T + 1, 2] goal centre, metres.
      hazards: [H, 2] hazard centres.
      pillars: [Q, 2] pillar centres.
      reward: [T] rewards.
      cost: [T] extrinsic costs.
      constraint_lidar: [T, 8] what the intrinsic cost sees.
    """

    qpos: np.ndarray
    goal_xy: np.ndarray
    hazards: np.ndarray
    pillars: np.ndarray
    reward: np.ndarray
    cost: np.ndarray
    constraint_lidar: np.ndarray


def _nothing(worlds: EnvState) -> tuple[()]:
    del worlds
    return ()


def run_episodes(
    env: Env,
    agent: Agent,
    agent_state: Any,
    key: Key,
    num_episodes: int,
    deterministic: bool = False,
    watch: Callable[[EnvState], Any] = _nothing,
) -> Episodes:
    """`num_episodes` whole episodes side by side.

    Args:
      env: the environment.
      agent: the algorithm the state belongs to.
      agent_state: one agent's state.
      key: consumed.
      num_episodes: E.
      deterministic: act by the mean instead of sampling.
      watch: worlds [E, ...] -> what else to keep of them, such as the poses that a
        replay is made of.

    Raises:
      ValueError: no episode is asked for.
    """
    require(COUNT.holds(num_episodes), "num_episodes", COUNT.allowed, num_episodes)
    key_reset, key_act = jax.random.split(key)
    start = reset_worlds(env, key_reset, num_episodes)

    def body(worlds: EnvState, t: jax.Array):
        action = agent.policy(
            agent_state, worlds.obs, jax.random.fold_in(key_act, t), deterministic
        )
        worlds = jax.vmap(env.step)(worlds, action)
        valid = (~worlds.failed).astype(worlds.reward.dtype)
        return worlds, (worlds.reward, worlds.cost_inputs, valid, watch(worlds))

    worlds, rows = jax.lax.scan(body, start, jnp.arange(env.episode_length))
    reward, cost_inputs, valid, watched = rows
    return Episodes(
        start=start.layout,
        reward=reward,
        cost_inputs=cost_inputs,
        valid=valid,
        watched=jax.tree.map(
            lambda first, rest: jnp.concatenate([first[None], rest]),
            watch(start),
            watched,
        ),
        distance_travelled=worlds.metrics["distance_travelled"].astype(jnp.float32),
        steps_outside=worlds.metrics["steps_outside"].astype(jnp.float32),
    )


def watch_first(worlds: EnvState) -> dict[str, jax.Array]:
    """What a `Recording` needs of the first of many worlds; see `run_episodes`."""
    return {"qpos": worlds.data.qpos[0], "goal_xy": worlds.layout.goal_xy[0]}


def first_recording(episodes: Any) -> Recording:
    """The first of the `Episodes` that `watch_first` has watched, jax or numpy."""
    return Recording(
        qpos=episodes.watched["qpos"],
        goal_xy=episodes.watched["goal_xy"],
        hazards=episodes.start.hazards[0],
        pillars=episodes.start.pillars[0],
        reward=episodes.reward[:, 0],
        cost=episodes.cost_inputs.cost[:, 0],
        constraint_lidar=episodes.cost_inputs.constraint_lidar[:, 0],
    )


def score(episodes: Episodes) -> EvalResult:
    """The sums and the violation rate of whole episodes."""
    valid = episodes.valid
    ep_cost = jnp.sum(valid * episodes.cost_inputs.cost, axis=0)
    whole = valid[-1]  # validity never comes back within an episode
    return EvalResult(
        ep_return=jnp.sum(valid * episodes.reward, axis=0),
        ep_cost=ep_cost,
        distance_travelled=episodes.distance_travelled,
        outside_share=episodes.steps_outside / valid.shape[0],
        valid=whole,
        violation_rate=mean_of((ep_cost > 0).astype(whole.dtype), whole),
    )


@functools.partial(
    jax.jit, static_argnames=("env", "agent", "num_episodes", "deterministic")
)
def evaluate(
    env: Env,
    agent: Agent,
    agent_state: Any,
    key: Key,
    num_episodes: int,
    deterministic: bool = False,
) -> EvalResult:
    """Scores of a fixed policy over whole episodes of fresh layouts.

    It is compiled at the first call with an environment and an agent, each made once,
    and a number of episodes, and kept for other states and keys. Arguments as in
    `run_episodes`.

    Returns:
      EvalResult, fields [E].
    """
    return score(
        run_episodes(env, agent, agent_state, key, num_episodes, deterministic)
    )
