"""PPO-Lagrangian; a slot with `constrained` 0 is plain PPO.

Source: openai/safety-starter-agents, with the multiplier held constant inside the
policy loss and the KL stop tested before a pass instead of after it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from autocost_jax.agents.advantages import weighted_mean
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
from autocost_jax.agents.networks import log_prob, make_networks
from autocost_jax.agents.passes import take_passes
from autocost_jax.config import AgentConfig
from autocost_jax.precision import full_precision
from autocost_jax.records import Key, Metrics, Slot, Trajectory


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


class MultiplierRule(NamedTuple):
    """How the weight of the cost follows the cost.

    Attributes:
      init: () -> (multiplier, memory), pytrees of arrays.
      step: (multiplier, memory, j_c, limit) -> (multiplier, memory, weight []); once an
        epoch, before the policy learns.
    """

    init: Callable[[], tuple[Any, Any]]
    step: Callable[..., tuple[Any, Any, jax.Array]]


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


def ppo_lagrangian(config: AgentConfig, env: EnvSizes) -> Agent:
    """PPO with a cost term whose weight rises while J_c exceeds the limit.

    Args:
      config: hyper-parameters.
      env: asked for its sizes only.

    Returns:
      The agent, with the metrics of `lagrangian_agent`.
    """
    return lagrangian_agent(config, env, gradient_rule(config))


def lagrangian_agent(config: AgentConfig, env: EnvSizes, rule: MultiplierRule) -> Agent:
    """PPO with a cost term weighed by a multiplier.

    Args:
      config: hyper-parameters.
      env: asked for its sizes only.
      rule: of the multiplier.

    Returns:
      The agent. Metrics of an update: `j_c`, `kl`, `policy_loss`, `value_loss`,
      `cost_value_loss`, `entropy`, `policy_steps`, `policy_grad_norm`,
      `critic_grad_norm`, `valid_fraction`, `multiplier` (constrained * lambda after
      its step) and `cost_weight` = multiplier / (1 + multiplier).
    """
    networks = make_networks(config, env.observation_size, env.action_size)

    def init(key: Key) -> AgentState:
        policy, critic = networks.init(key)
        multiplier, memory = rule.init()
        return AgentState(
            policy=policy,
            critic=critic,
            policy_opt=optax.adam(config.policy_lr).init(policy),
            critic_opt=critic_optimizer(config).init(critic),
            multiplier=multiplier,
            multiplier_opt=memory,
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
        multiplier, memory, weight = rule.step(
            state.multiplier, state.multiplier_opt, metrics["j_c"], slot.cost.limit
        )
        weight = slot.constrained * jax.lax.stop_gradient(weight)

        def loss(
            mean: jax.Array, log_std: jax.Array, action: jax.Array, columns: jax.Array
        ) -> jax.Array:
            new = log_prob(action, mean, log_std)
            return policy_loss(new, columns, weight, config.clip_eps)

        columns = jnp.column_stack(
            [batch.log_prob_old, batch.advantage, batch.cost_advantage, batch.weight]
        )
        policy, policy_opt, policy_metrics = take_passes(
            config,
            networks,
            state.policy,
            state.policy_opt,
            batch,
            loss,
            columns,
            config.kl_stop_factor * config.target_kl,
            key_policy,
        )
        critic, critic_opt, critic_norm = update_critics(
            config, networks, state.critic, state.critic_opt, batch, key_critic
        )
        new_state = AgentState(
            policy=policy,
            critic=critic,
            policy_opt=policy_opt,
            critic_opt=critic_opt,
            multiplier=multiplier,
            multiplier_opt=memory,
            normalizer=learn_obs(state, trajectory),
        )
        metrics = {
            **metrics,
            **policy_metrics,
            "critic_grad_norm": critic_norm,
            "multiplier": weight,
            "cost_weight": weight / (1.0 + weight),
        }
        return new_state, as_metrics(metrics)

    return Agent(init, make_policy(networks), update)
