"""First-order constrained optimisation in policy space (Zhang et al. 2020).

Source: arXiv:2002.06506 and its published hyper-parameters.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.agents.advantages import normalise, weighted_mean
from autocost_jax.agents.base import Agent, Batch, EnvSizes
from autocost_jax.agents.first_order import Loss, MultiplierRule, first_order_agent
from autocost_jax.agents.networks import kl_divergence, log_prob
from autocost_jax.config import AgentConfig


class FocopsSettings(NamedTuple):
    """Lambda, the step of the cost's weight nu along J_c - d, and the most of nu."""

    temperature: float = 1.5
    nu_lr: float = 0.01
    nu_max: float = 2.0


def focops_loss(
    kl: jax.Array,
    log_ratio: jax.Array,
    advantage: jax.Array,
    weight: jax.Array,
    near: float,
    temperature: float,
) -> jax.Array:
    """Mean of KL - rho A / lambda, where states whose KL exceeds `near` count with 0.

    Args:
      kl: [r] KL(new || old) of each state.
      log_ratio: [r] ln rho.
      advantage: [r] A - nu A_c.
      weight: [r] 0.0 or 1.0.
      near: a KL.
      temperature: lambda.
    """
    is_near = jax.lax.stop_gradient(kl) <= near
    ratio = jnp.exp(jnp.where(is_near, log_ratio, 0.0))  # elsewhere it may be infinite
    rows = kl - ratio * advantage / temperature
    return weighted_mean(jnp.where(is_near, rows, 0.0), weight)


def focops(
    config: AgentConfig,
    env: EnvSizes,
    settings: FocopsSettings = FocopsSettings(),  # noqa: B008, a tuple of numbers
) -> Agent:
    """Descend the KL to the constrained optimum among all policies.

    `target_kl` bounds the KL of a state that counts and the mean that ends the passes.
    Both advantages are normalised, so that nu means alike whatever the scale of costs.

    Args:
      config: hyper-parameters; clip and multiplier are not used.
      env: asked for its sizes only.
      settings: of FOCOPS alone.

    Returns:
      The agent, with the metrics of `first_order_agent`; `multiplier` is nu.
    """

    def init() -> tuple[jax.Array, tuple[()]]:
        return jnp.zeros((), jnp.result_type(float)), ()

    def step(
        nu: jax.Array, memory: tuple[()], j_c: jax.Array, limit: jax.Array
    ) -> tuple[jax.Array, tuple[()], jax.Array]:
        nu = jnp.clip(nu + settings.nu_lr * (j_c - limit), 0.0, settings.nu_max)
        return nu, memory, nu

    def make_loss(batch: Batch, nu: jax.Array) -> tuple[Loss, jax.Array]:
        def loss(
            mean: jax.Array, log_std: jax.Array, action: jax.Array, columns: jax.Array
        ) -> jax.Array:
            mean_old, (old, advantage, weight) = columns[:, :-3], columns[:, -3:].T
            kl = kl_divergence(mean, log_std, mean_old, batch.log_std_old)
            log_ratio = log_prob(action, mean, log_std) - old
            near, temperature = config.target_kl, settings.temperature
            return focops_loss(kl, log_ratio, advantage, weight, near, temperature)

        cost_advantage = normalise(batch.cost_advantage, batch.weight)
        advantage = batch.advantage - nu * cost_advantage
        columns = [batch.mean_old, batch.log_prob_old, advantage, batch.weight]
        return loss, jnp.column_stack(columns)

    rule = MultiplierRule(init, step)
    return first_order_agent(config, env, rule, make_loss, config.target_kl)
