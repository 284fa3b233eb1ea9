"""Small trajectories and slots for the agents' tests; no environment needed."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.agents.trust_region import linearise
from autocost_jax.config import AgentConfig
from autocost_jax.records import CostInputs, Slot, TrainingCost, Trajectory

SMALL = AgentConfig(
    hidden_sizes=(16, 16),
    policy_passes=4,
    policy_minibatches=2,
    value_passes=4,
    value_minibatches=2,
)
FULL_BATCH = AgentConfig(hidden_sizes=(16, 16), policy_passes=8, value_passes=8)


class Sizes(NamedTuple):
    observation_size: int = 3
    action_size: int = 2
    episode_length: int = 20


SIZES = Sizes()


def make_slot(limit=0.0, constrained=1.0):
    cost = TrainingCost(
        weights=jnp.zeros(6), theta=jnp.zeros(41), limit=jnp.asarray(limit)
    )
    return Slot(
        cost=cost,
        key=jax.random.key(0),
        constrained=jnp.asarray(constrained, jnp.float32),
    )


def make_trajectory(obs, action, reward, valid=None):
    zeros = jnp.zeros_like(reward)
    return Trajectory(
        obs=obs,
        action=action,
        reward=reward,
        cost_inputs=CostInputs(zeros, jnp.zeros((*reward.shape, 8)), *[zeros] * 3),
        valid=jnp.ones_like(reward) if valid is None else valid,
    )


def act(agent, state, key, sizes=SIZES, num_worlds=8):
    """Random observations [T + 1, N, O] and sampled actions [T, N, U]."""
    key_obs, key_act = jax.random.split(key)
    shape = (sizes.episode_length + 1, num_worlds, sizes.observation_size)
    obs = jax.random.uniform(key_obs, shape)
    return obs, agent.policy(state, obs[:-1], key_act)


def fisher_product(distribution, theta, weight, damping):
    """(F + damping I) z of any policy, by derivatives: an oracle for the factored one.

    F z = J^T [w_r / std^2 * (J_mu z), 2 * (J_log_std z)],  sum_r w_r = 1
    """
    lin = linearise(distribution, theta)
    share = weight / jnp.maximum(jnp.sum(weight), 1.0)
    scale = share[:, None] * jnp.exp(-2.0 * lin.log_std)[None, :]

    def product(direction):
        mean, log_std = lin.jvp(direction)
        return lin.vjp((scale * mean, 2.0 * log_std)) + damping * direction

    return jax.vmap(product)
