"""Whole episodes of a fixed policy on fresh layouts."""

from typing import Any

import jax
import jax.numpy as jnp

from autocost_jax.agents.base import Agent
from autocost_jax.envs.env import Env
from autocost_jax.records import EnvState, EvalResult, Key, Trajectory
from autocost_jax.rollout import reset_worlds, unroll


def run_episodes(
    env: Env,
    agent: Agent,
    agent_state: Any,
    key: Key,
    num_episodes: int,
    deterministic: bool = False,
) -> tuple[EnvState, Trajectory]:
    """`num_episodes` whole episodes side by side: the last worlds and all steps.

    Returns:
      Worlds [E, ...] and the Trajectory, fields [T, E, ...].
    """
    key_reset, key_act = jax.random.split(key)
    worlds = reset_worlds(env, key_reset, num_episodes)

    def policy(obs: jax.Array, key: Key) -> jax.Array:
        return agent.policy(agent_state, obs, key, deterministic)

    return unroll(env, policy, worlds, key_act, env.episode_length)


def evaluate(
    env: Env,
    agent: Agent,
    agent_state: Any,
    key: Key,
    num_episodes: int,
    deterministic: bool = False,
) -> EvalResult:
    """Scores of a fixed policy over whole episodes of fresh layouts.

    Args:
      env: the environment.
      agent: the algorithm the state belongs to.
      agent_state: one agent's state.
      key: consumed.
      num_episodes: E.
      deterministic: act by the mean instead of sampling.

    Returns:
      EvalResult, fields [E].
    """
    worlds, trajectory = run_episodes(
        env, agent, agent_state, key, num_episodes, deterministic
    )
    valid = trajectory.valid
    ep_cost = jnp.sum(valid * trajectory.cost_inputs.cost, axis=0)
    whole = valid[-1]  # validity never comes back within an episode
    violations = jnp.sum(whole * (ep_cost > 0))
    return EvalResult(
        ep_return=jnp.sum(valid * trajectory.reward, axis=0),
        ep_cost=ep_cost,
        distance_travelled=worlds.metrics["distance_travelled"].astype(valid.dtype),
        valid=whole,
        # An integer count: the floor only keeps 0 / 0 away.
        violation_rate=violations / jnp.maximum(jnp.sum(whole), 1.0),
    )
