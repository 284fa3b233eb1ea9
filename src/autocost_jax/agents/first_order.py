"""Agents that learn by passes of Adam steps and weigh the cost by a multiplier."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.agents.base import (
    Agent,
    AgentState,
    Batch,
    EnvSizes,
    as_metrics,
    global_norm,
    learn_obs,
    make_init,
    make_policy,
    prepare_batch,
    split_rows,
    update_critics,
)
from autocost_jax.agents.blocks import mean_over_blocks
from autocost_jax.agents.networks import (
    Networks,
    Params,
    entropy,
    kl_divergence,
    make_networks,
)
from autocost_jax.config import AgentConfig
from autocost_jax.precision import full_precision
from autocost_jax.records import Key, Metrics, Slot, Trajectory

# (mean [r, U], log_std [U], action [r, U], columns [r, C]) -> weighted mean over rows
Loss = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], jax.Array]
# (batch, weight of the cost []) -> the loss, and its columns [R, C]
MakeLoss = Callable[[Batch, jax.Array], tuple[Loss, jax.Array]]


class MultiplierRule(NamedTuple):
    """How the weight of the cost follows the cost.

    Attributes:
      init: () -> (multiplier, memory), pytrees of arrays.
      step: (multiplier, memory, j_c, limit) -> (multiplier, memory, weight []); once an
        epoch, before the policy learns.
    """

    init: Callable[[], tuple[Any, Any]]
    step: Callable[..., tuple[Any, Any, jax.Array]]


def first_order_agent(
    config: AgentConfig,
    env: EnvSizes,
    rule: MultiplierRule,
    make_loss: MakeLoss,
    kl_stop: float,
) -> Agent:
    """An agent whose policy descends a loss of the reward and the weighed cost.

    Args:
      config: hyper-parameters.
      env: asked for its sizes only.
      rule: of the cost's weight.
      make_loss: what an epoch's policy descends; the weight is 0 in a slot whose
        `constrained` is.
      kl_stop: the KL that ends an update's passes.

    Returns:
      The agent. Metrics of an update: `j_c`, `kl`, `policy_loss`, `value_loss`,
      `cost_value_loss`, `entropy`, `policy_steps`, `policy_grad_norm`,
      `critic_grad_norm`, `valid_fraction`, `multiplier` (constrained * the weight after
      its step) and `cost_weight` = multiplier / (1 + multiplier).
    """
    networks = make_networks(config, env.observation_size, env.action_size)

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
        policy, policy_opt, policy_metrics = take_passes(
            config,
            networks,
            state.policy,
            state.policy_opt,
            batch,
            *make_loss(batch, weight),
            kl_stop,
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

    optimizer = optax.adam(config.policy_lr)
    init = make_init(config, networks, env, optimizer, rule.init)
    return Agent(init, make_policy(networks), update)


def take_passes(
    config: AgentConfig,
    networks: Networks,
    params: Params,
    opt_state: Any,
    batch: Batch,
    loss: Loss,
    columns: jax.Array,
    kl_stop: float,
    key: Key,
) -> tuple[Params, Any, Metrics]:
    """The policy after at most `policy_passes` x `policy_minibatches` Adam steps.

    Before each pass the KL of the whole batch is tested at the current parameters;
    once it exceeds `kl_stop` no further step is taken.

    Args:
      config: passes, minibatches, learning rate.
      networks: of the agent.
      params: policy parameters.
      opt_state: Adam's state.
      batch: the epoch's rows.
      loss: what is descended, a mean over rows that weighs them by the last column.
      columns: [R, C] what `loss` needs of the rows beside their actions.
      kl_stop: the KL that ends the passes.
      key: consumed; orders the minibatches.

    Returns:
      Parameters, Adam's state and metrics: `kl`, `policy_loss`, `entropy` at the
      new parameters, `policy_steps` taken, `policy_grad_norm` at the first step.
    """
    optimizer = optax.adam(config.policy_lr)
    rows = (batch.obs, jnp.column_stack([batch.action, columns]))
    action_size = batch.action.shape[-1]

    def loss_fn(params: Params, rows: Any) -> tuple[jax.Array, Any]:
        obs, rest = rows
        at = networks.distribution(params, obs)
        return loss(*at, rest[:, :action_size], rest[:, action_size:]), at

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
        value, distribution = loss_fn(params, rows)
        return value, kl_of(distribution, mean_old, rows[1][:, -1])

    keys = jax.random.split(key, config.policy_passes)
    zero = jnp.zeros((), batch.obs.dtype)
    start = ((params, opt_state), jnp.zeros((), jnp.int32), jnp.zeros((), bool), zero)
    # Ends when all slots of a `vmap` have stopped.
    end = jax.lax.while_loop(is_running, one_pass, start)
    (params, opt_state), taken, _, first_norm = end
    value, kl = whole(at_end)
    return (
        params,
        opt_state,
        {
            "kl": kl,
            "policy_loss": value,
            "entropy": entropy(params["log_std"]),
            "policy_steps": taken * config.policy_minibatches,
            "policy_grad_norm": first_norm,
        },
    )
