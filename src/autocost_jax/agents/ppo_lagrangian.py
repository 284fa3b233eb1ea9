"""PPO-Lagrangian; a slot with `constrained` 0 is plain PPO.

Source: openai/safety-starter-agents, with the multiplier held constant inside the
policy loss and the KL stop tested before a pass instead of after it.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.agents.base import Agent, Batch, EnvSizes
from autocost_jax.agents.first_order import Loss, MultiplierRule, first_order_agent
from autocost_jax.agents.networks import log_prob
from autocost_jax.config import AgentConfig


def update_multiplier(
    config: AgentConfig,
    multiplier: jax.Array,
    opt_state: Any,
    j_c: jax.Array,
    limit: jax.Array,
) -> tuple[jax.Array, Any]:
    """One Adam step on p, whose softplus is the multiplier: dp = -(J_c - d).

    Args:
      config: learning rate.
      multiplier: [] p.
      opt_state: Adam's state.
      j_c: [] mean episode cost of this epoch.
      limit: [] allowed episode cost d.

    Returns:
      p and Adam's state.
    """
    updates, opt_state = optax.adam(config.multiplier_lr).update(
        -(j_c - limit), opt_state
    )
    return optax.apply_updates(multiplier, updates), opt_state  # pyright: ignore


def clipped_objective(
    ratio: jax.Array, advantage: jax.Array, clip_eps: float
) -> jax.Array:
    """min(ratio A, g(A)), g(A) = (1 + eps) A if A > 0 else (1 - eps) A, elementwise."""
    bound = jnp.where(advantage > 0, 1 + clip_eps, 1 - clip_eps) * advantage
    return jnp.minimum(ratio * advantage, bound)


def policy_loss(
    log_prob_new: jax.Array,
    rows: jax.Array,
    multiplier: jax.Array,
    clip_eps: float,
) -> jax.Array:
    """Loss whose descent raises reward and lowers cost.

        -[mean min(rho A, g(A)) - lambda mean(rho A_c)] / (1 + lambda)

    Args:
      log_prob_new: [B] of the actions under the policy to be improved.
      rows: [B, 4] log_prob_old, advantage, cost_advantage, weight.
      multiplier: [] lambda >= 0; 0 leaves exactly PPO's loss.
      clip_eps: of the reward's ratio; the cost's ratio is not clipped.

    Returns:
      Scalar.
    """
    log_prob_old, advantage, cost_advantage, weight = rows.T
    ratio = jnp.exp(log_prob_new - log_prob_old)
    gain = weighted_mean(clipped_objective(ratio, advantage, clip_eps), weight)
    price = weighted_mean(ratio * cost_advantage, weight)
    return -(gain - multiplier * price) / (1.0 + multiplier)


def gradient_rule(config: AgentConfig) -> MultiplierRule:
    """The weight is softplus(p), and p climbs along J_c - d by Adam."""

    def init() -> tuple[Any, Any]:
        # softplus(p) = multiplier_init
        start = np.log(np.expm1(config.multiplier_init))
        p = jnp.asarray(start, jnp.result_type(float))
        return p, optax.adam(config.multiplier_lr).init(p)

    def step(
        p: jax.Array, memory: Any, j_c: jax.Array, limit: jax.Array
    ) -> tuple[jax.Array, Any, jax.Array]:
        p, memory = update_multiplier(config, p, memory, j_c, limit)
        return p, memory, jax.nn.softplus(p)

    return MultiplierRule(init, step)


def ppo_agent(config: AgentConfig, env: EnvSizes, rule: MultiplierRule) -> Agent:
    """PPO with a cost term weighed by the multiplier of a rule."""

    def make_loss(batch: Batch, multiplier: jax.Array) -> tuple[Loss, jax.Array]:
        def loss(
            mean: jax.Array, log_std: jax.Array, action: jax.Array, columns: jax.Array
        ) -> jax.Array:
            new = log_prob(action, mean, log_std)
            return policy_loss(new, columns, multiplier, config.clip_eps)

        columns = [batch.log_prob_old, batch.advantage, batch.cost_advantage]
        return loss, jnp.column_stack([*columns, batch.weight])

    kl_stop = config.kl_stop_factor * config.target_kl
    return first_order_agent(config, env, rule, make_loss, kl_stop)


def ppo_lagrangian(config: AgentConfig, env: EnvSizes) -> Agent:
    """PPO with a cost term whose weight rises while J_c exceeds the limit.

    Args:
      config: hyper-parameters.
      env: asked for its sizes only.

    Returns:
      The agent, with the metrics of `first_order_agent`.
    """
    return ppo_agent(config, env, gradient_rule(config))
