"""PPO-Lagrangian; a slot with `constrained` 0 is plain PPO.

Source: openai/safety-starter-agents, with the multiplier held constant inside the
policy loss and the KL stop tested before a pass instead of after it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.agents.base import (
    Agent,
    AgentState,
    Batch,
    EnvSizes,
    as_metrics,
    critic_optimizer,
    global_norm,
    learn_obs,
    make_policy,
    prepare_batch,
    split_rows,
    start_normalizer,
    update_critics,
)
from autocost_jax.agents.blocks import mean_over_blocks
from autocost_jax.agents.networks import (
    Networks,
    Params,
    entropy,
    kl_divergence,
    log_prob,
    make_networks,
)
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


def update_policy(
    config: AgentConfig,
    networks: Networks,
    params: Params,
    opt_state: Any,
    batch: Batch,
    multiplier: jax.Array,
    key: Key,
) -> tuple[Params, Any, Metrics]:
    """The policy after at most `policy_passes` x `policy_minibatches` Adam steps.

    Before each pass the KL of the whole batch is tested at the current parameters;
    once it exceeds kl_stop_factor * target_kl no further step is taken.

    Args:
      config: passes, minibatches, learning rate, clip, KL stop.
      networks: of the agent.
      params: policy parameters.
      opt_state: Adam's state.
      batch: the epoch's rows.
      multiplier: [] lambda, a constant here.
      key: consumed; orders the minibatches.

    Returns:
      Parameters, Adam's state and metrics: `kl`, `policy_loss`, `entropy` at the
      new parameters, `policy_steps` taken, `policy_grad_norm` at the first step.
    """
    optimizer = optax.adam(config.policy_lr)
    kl_stop = config.kl_stop_factor * config.target_kl
    rest = jnp.column_stack(
        [batch.log_prob_old, batch.advantage, batch.cost_advantage, batch.weight]
    )
    rows = (batch.obs, jnp.column_stack([batch.action, rest]))
    action_size = batch.action.shape[-1]

    def loss_fn(params: Params, rows: Any) -> tuple[jax.Array, Any]:
        obs, rest = rows
        mean, log_std = networks.distribution(params, obs)
        new = log_prob(rest[:, :action_size], mean, log_std)
        loss = policy_loss(new, rest[:, action_size:], multiplier, config.clip_eps)
        return loss, (mean, log_std)

    def kl_of(
        distribution: tuple[jax.Array, jax.Array],
        mean_old: jax.Array,
        weight: jax.Array,
    ) -> jax.Array:
        kl = kl_divergence(*distribution, mean_old, batch.log_std_old)
        return weighted_mean(kl, weight)

    def whole(function: Callable[[Any, jax.Array], Any]) -> Any:
        """Means over the whole batch, of a function of (rows, mean_old)."""
        return mean_over_blocks(
            lambda block: function(*block), (rows, batch.mean_old), batch.weight
        )

    def apply(carry: Any, grads: Any) -> Any:
        params, opt_state = carry
        updates, opt_state = optimizer.update(grads, opt_state)
        return optax.apply_updates(params, updates), opt_state

    def minibatch_step(carry: Any, rows: Any) -> tuple[Any, jax.Array]:
        grads = mean_over_blocks(
            lambda rows: jax.grad(loss_fn, has_aux=True)(carry[0], rows)[0],
            rows,
            rows[1][:, -1],
        )
        return apply(carry, grads), global_norm(grads)

    def one_pass(carry: tuple[Any, jax.Array, jax.Array, jax.Array]) -> Any:
        old, taken, _, first_norm = carry

        def kl_and_grads(rows: Any, mean_old: jax.Array) -> Any:
            grads, distribution = jax.grad(loss_fn, has_aux=True)(old[0], rows)
            return kl_of(distribution, mean_old, rows[1][:, -1]), grads

        def kl_alone(rows: Any, mean_old: jax.Array) -> jax.Array:
            distribution = networks.distribution(old[0], rows[0])
            return kl_of(distribution, mean_old, rows[1][:, -1])

        if config.policy_minibatches == 1:
            # The gradient's own forward pass is the whole batch at `old`.
            kl, grads = whole(kl_and_grads)
            new, norm = apply(old, grads), global_norm(grads)
        else:
            kl = whole(kl_alone)
            split = split_rows(keys[taken], rows, config.policy_minibatches)
            new, norms = jax.lax.scan(minibatch_step, old, split)
            norm = norms[0]
        stopped = ~(kl <= kl_stop)  # so written that a NaN stops as well
        kept = jax.tree.map(lambda a, b: jnp.where(stopped, a, b), old, new)
        first_norm = jnp.where(taken == 0, norm, first_norm)
        return kept, taken + ~stopped, stopped, first_norm

    def is_running(carry: tuple[Any, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, taken, stopped, _ = carry
        return ~stopped & (taken < config.policy_passes)

    def at_end(rows: Any, mean_old: jax.Array) -> tuple[jax.Array, jax.Array]:
        loss, distribution = loss_fn(params, rows)
        return loss, kl_of(distribution, mean_old, rows[1][:, -1])

    keys = jax.random.split(key, config.policy_passes)
    zero = jnp.zeros((), batch.obs.dtype)
    start = ((params, opt_state), jnp.zeros((), jnp.int32), jnp.zeros((), bool), zero)
    # Ends when all slots of a `vmap` have stopped.
    end = jax.lax.while_loop(is_running, one_pass, start)
    (params, opt_state), taken, _, first_norm = end
    loss, kl = whole(at_end)
    return (
        params,
        opt_state,
        {
            "kl": kl,
            "policy_loss": loss,
            "entropy": entropy(params["log_std"]),
            "policy_steps": taken * config.policy_minibatches,
            "policy_grad_norm": first_norm,
        },
    )


def ppo_lagrangian(config: AgentConfig, env: EnvSizes) -> Agent:
    """PPO with a cost term whose weight rises while J_c exceeds the limit.

    Args:
      config: hyper-parameters.
      env: asked for its sizes only.

    Returns:
      The agent. Metrics of an update: `j_c`, `kl`, `policy_loss`, `value_loss`,
      `cost_value_loss`, `entropy`, `policy_steps`, `policy_grad_norm`,
      `critic_grad_norm`, `valid_fraction`, `multiplier` (constrained * lambda after
      its step) and `cost_weight` = multiplier / (1 + multiplier).
    """
    networks = make_networks(config, env.observation_size, env.action_size)

    def init(key: Key) -> AgentState:
        policy, critic = networks.init(key)
        dtype = jnp.result_type(float)
        # softplus(p) = multiplier_init
        p = jnp.asarray(np.log(np.expm1(config.multiplier_init)), dtype)
        return AgentState(
            policy=policy,
            critic=critic,
            policy_opt=optax.adam(config.policy_lr).init(policy),
            critic_opt=critic_optimizer(config).init(critic),
            multiplier=p,
            multiplier_opt=optax.adam(config.multiplier_lr).init(p),
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
        p, multiplier_opt = update_multiplier(
            config,
            state.multiplier,
            state.multiplier_opt,
            metrics["j_c"],
            slot.cost.limit,
        )
        multiplier = slot.constrained * jax.lax.stop_gradient(jax.nn.softplus(p))
        policy, policy_opt, policy_metrics = update_policy(
            config,
            networks,
            state.policy,
            state.policy_opt,
            batch,
            multiplier,
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
            multiplier=p,
            multiplier_opt=multiplier_opt,
            normalizer=learn_obs(state, trajectory),
        )
        metrics = {
            **metrics,
            **policy_metrics,
            "critic_grad_norm": critic_norm,
            "multiplier": multiplier,
            "cost_weight": multiplier / (1.0 + multiplier),
        }
        return new_state, as_metrics(metrics)

    return Agent(init, make_policy(networks), update)
