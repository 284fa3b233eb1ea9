"""First-order constrained optimisation in policy space (Zhang et al. 2020).

Source: arXiv:2002.06506 and its published hyper-parameters.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from autocost_jax.agents.advantages import normalise, weighted_mean
from autocost_jax.agents.base import (
    Agent,
    AgentState,
    EnvSizes,
    as_metrics,
    critic_optimizer,
    learn_obs,
    make_policy,
    prepare_batch,
    start_normalizer,
    update_critics,
)
from autocost_jax.agents.networks import kl_divergence, log_prob, make_networks
from autocost_jax.agents.passes import take_passes
from autocost_jax.config import AgentConfig
from autocost_jax.precision import full_precision
from autocost_jax.records import Key, Metrics, Slot, Trajectory


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
      The agent, with the metrics of `lagrangian_agent`; `multiplier` is nu.
    """
    networks = make_networks(config, env.observation_size, env.action_size)

    def init(key: Key) -> AgentState:
        policy, critic = networks.init(key)
        return AgentState(
            policy=policy,
            critic=critic,
            policy_opt=optax.adam(config.policy_lr).init(policy),
            critic_opt=critic_optimizer(config).init(critic),
            multiplier=jnp.zeros((), jnp.result_type(float)),
            multiplier_opt=(),
            normalizer=start_normalizer(config, env),
        )

    @full_precision
    def update(
        state: AgentState,
        trajectory: Trajectory,
        total_cost: jax.Array,
        slot: Slot,
        key: Key,
    ) -> tuple[AgentState, Metrics]:
        key_policy, key_critic = jax.random.split(key)
        batch, metrics = prepare_batch(
            config, networks, env.episode_length, state, trajectory, total_cost
        )
        climb = settings.nu_lr * (metrics["j_c"] - slot.cost.limit)
        nu = jnp.clip(state.multiplier + climb, 0.0, settings.nu_max)
        weight = slot.constrained * nu
        cost_advantage = normalise(batch.cost_advantage, batch.weight)
        advantage = batch.advantage - weight * cost_advantage
        columns = jnp.column_stack(
            [batch.mean_old, batch.log_prob_old, advantage, batch.weight]
        )

        def loss(
            mean: jax.Array, log_std: jax.Array, action: jax.Array, columns: jax.Array
        ) -> jax.Array:
            mean_old, (old, advantage, weight) = columns[:, :-3], columns[:, -3:].T
            kl = kl_divergence(mean, log_std, mean_old, batch.log_std_old)
            log_ratio = log_prob(action, mean, log_std) - old
            near, temperature = config.target_kl, settings.temperature
            return focops_loss(kl, log_ratio, advantage, weight, near, temperature)

        policy, policy_opt, policy_metrics = take_passes(
            config, networks, state.policy, state.policy_opt, batch, loss, columns,
            config.target_kl, key_policy,
        )  # fmt: skip
        critic, critic_opt, critic_norm = update_critics(
            config, networks, state.critic, state.critic_opt, batch, key_critic
        )
        new_state = state.replace(
            policy=policy,
            critic=critic,
            policy_opt=policy_opt,
            critic_opt=critic_opt,
            multiplier=nu,
            normalizer=learn_obs(state, trajectory),
        )
        metrics |= policy_metrics | {
            "critic_grad_norm": critic_norm,
            "multiplier": weight,
            "cost_weight": weight / (1.0 + weight),
        }
        return new_state, as_metrics(metrics)

    return Agent(init, make_policy(networks), update)
