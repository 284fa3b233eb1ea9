"""What all agents share: the bundle of functions, the batch, the critics' update.

An update reduces over one agent's batch only and weights every row by its validity,
so that it can be vmapped over slots.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from autocost_jax.agents.advantages import centre, gae, normalise, weighted_mean
from autocost_jax.agents.blocks import mean_over_blocks
from autocost_jax.agents.networks import (
    COST,
    REWARD,
    Networks,
    Params,
    log_prob,
    sample,
)
from autocost_jax.agents.normalizer import (
    init_normalizer,
    normalize_obs,
    update_normalizer,
)
from autocost_jax.config import AgentConfig
from autocost_jax.records import Key, Metrics, Trajectory


class EnvSizes(Protocol):
    """All that an agent asks of an environment."""

    @property
    def observation_size(self) -> int:
        """O."""
        ...

    @property
    def action_size(self) -> int:
        """U."""
        ...

    @property
    def episode_length(self) -> int:
        """Steps of a whole episode."""
        ...


class AgentState(struct.PyTreeNode):
    """Everything an agent carries from epoch to epoch.

    Attributes:
      policy: parameters of the policy.
      critic: parameters of the reward and the cost critic, stacked on an axis of 2.
      policy_opt: Adam's state; () for CPO.
      critic_opt: Adam's state.
      multiplier: [] of PPO-Lagrangian p, the multiplier is softplus(p); () for CPO.
      multiplier_opt: what its rule remembers, such as Adam's state; () for CPO.
      normalizer: of the observations; () without `AgentConfig.normalize_obs`.
    """

    policy: Params
    critic: Params
    policy_opt: Any
    critic_opt: Any
    multiplier: Any
    multiplier_opt: Any
    normalizer: Any = ()


class Actor(NamedTuple):
    """The part of an `AgentState` that acts, and that a policy's file holds.

    Attributes:
      policy: parameters of the policy.
      normalizer: of its observations, or ().
    """

    policy: Params
    normalizer: Any


def actor(state: AgentState) -> Actor:
    """The acting part of an agent."""
    return Actor(state.policy, state.normalizer)


def start_normalizer(config: AgentConfig, env: EnvSizes) -> Any:
    """The normalizer that an agent begins with; () if it has none."""
    return init_normalizer(env.observation_size) if config.normalize_obs else ()


def make_init(
    config: AgentConfig,
    networks: Networks,
    env: EnvSizes,
    optimizer: optax.GradientTransformation | None = None,
    multiplier: Callable[[], tuple[Any, Any]] = lambda: ((), ()),
) -> Callable[[Key], AgentState]:
    """The function of `Agent.init`.

    Args:
      config: hyper-parameters.
      networks: of the agent.
      env: asked for its sizes only.
      optimizer: of the policy; None: it has no state.
      multiplier: () -> the multiplier and its memory.
    """

    def init(key: Key) -> AgentState:
        policy, critic = networks.init(key)
        start, memory = multiplier()
        return AgentState(
            policy=policy,
            critic=critic,
            policy_opt=() if optimizer is None else optimizer.init(policy),
            critic_opt=critic_optimizer(config).init(critic),
            multiplier=start,
            multiplier_opt=memory,
            normalizer=start_normalizer(config, env),
        )

    return init


def seen_by(state: AgentState, obs: jax.Array) -> jax.Array:
    """Observations [..., O] as the agent's networks see them."""
    return normalize_obs(state.normalizer, obs) if state.normalizer else obs


def learn_obs(state: AgentState, trajectory: Trajectory) -> Any:
    """The normalizer after an epoch; the next one acts by it."""
    if not state.normalizer:
        return ()
    return update_normalizer(state.normalizer, trajectory.obs[:-1], trajectory.valid)


class Agent(NamedTuple):
    """A learner as pure functions of one slot; vmap them over slots.

    Attributes:
      init: key -> state.
      policy: (state, obs [..., O], key, deterministic=False) -> action [..., U];
        `deterministic` is a Python bool, sampled actions are not clipped, the key
        is consumed.
      update: (state, trajectory, total_cost [T, N], slot, key) -> (state, metrics);
        the key is consumed, the state keeps its type, metrics are float32 scalars.
    """

    init: Callable[[Key], Any]
    policy: Callable[..., jax.Array]
    update: Callable[..., tuple[Any, Metrics]]


class Batch(struct.PyTreeNode):
    """One epoch of one agent as R = T * N rows.

    Attributes:
      obs: [R, O] as the networks see them.
      action: [R, U].
      weight: [R] 1.0 where the row counts, else 0.0; then all else in the row is 0
        (obs: that of the state in which the world failed).
      mean_old: [R, U] mean of the policy at the update's start.
      log_std_old: [U] its log std.
      log_prob_old: [R] log density of `action` under it.
      advantage: [R] of the reward, normalised.
      cost_advantage: [R] centred, in units of cost.
      target: [R, 2] what the reward and the cost critic are fitted to.
    """

    obs: jax.Array
    action: jax.Array
    weight: jax.Array
    mean_old: jax.Array
    log_std_old: jax.Array
    log_prob_old: jax.Array
    advantage: jax.Array
    cost_advantage: jax.Array
    target: jax.Array


def make_policy(networks: Networks) -> Callable[..., jax.Array]:
    """The acting function of `Agent.policy`."""

    def policy(
        state: AgentState, obs: jax.Array, key: Key, deterministic: bool = False
    ) -> jax.Array:
        mean, log_std = networks.distribution(state.policy, seen_by(state, obs))
        return mean if deterministic else sample(key, mean, log_std)

    return policy


def prepare_batch(
    config: AgentConfig,
    networks: Networks,
    episode_length: int,
    state: AgentState,
    trajectory: Trajectory,
    total_cost: jax.Array,
) -> tuple[Batch, Metrics]:
    """Rows with advantages and targets from the critics of the rollout's time.

    Args:
      config: discounts.
      networks: of the agent.
      episode_length: steps of a whole episode.
      state: before the update.
      trajectory: one epoch; rows of weight 0 may hold anything, even NaN.
      total_cost: [T, N] the cost that the learner sees.

    Returns:
      The batch, and the metrics `j_c` (episode_length times the mean cost of a step,
      equal to the mean episode sum of whole episodes), `value_loss` and
      `cost_value_loss` (mean squared errors before the update), `valid_fraction`.
    """
    num_steps, num_worlds = trajectory.reward.shape
    chex.assert_shape([total_cost, trajectory.valid], (num_steps, num_worlds))
    valid = trajectory.valid > 0
    # s_t counts if it was reached by a valid step: it may bootstrap the row before.
    reached = jnp.concatenate([jnp.ones_like(valid[:1]), valid])
    obs = jnp.where(reached[..., None], trajectory.obs, 0.0)
    obs = seen_by(state, obs)
    action = jnp.where(valid[..., None], trajectory.action, 0.0)
    signal = jnp.stack([trajectory.reward, total_cost])
    signal = jnp.where(valid[None], signal, 0.0)

    flat_obs = obs.reshape(-1, obs.shape[-1])
    value = networks.values(state.critic, flat_obs)
    value = value.reshape(2, num_steps + 1, num_worlds)
    gammas = jnp.asarray([config.gamma, config.cost_gamma], value.dtype)
    lambdas = jnp.asarray([config.gae_lambda, config.cost_gae_lambda], value.dtype)
    advantage, target = jax.vmap(gae, in_axes=(0, 0, 0, 0, None))(
        signal, value, gammas, lambdas, valid
    )

    num_rows = num_steps * num_worlds
    weight = valid.astype(value.dtype)
    flat_obs = flat_obs[:num_rows]
    action = action.reshape(num_rows, -1)
    mean, log_std = networks.distribution(state.policy, flat_obs)
    batch = Batch(
        obs=flat_obs,
        action=action,
        weight=weight.reshape(num_rows),
        mean_old=mean,
        log_std_old=log_std,
        log_prob_old=log_prob(action, mean, log_std),
        advantage=normalise(advantage[REWARD], weight).reshape(num_rows),
        cost_advantage=centre(advantage[COST], weight).reshape(num_rows),
        target=target.reshape(2, num_rows).T,
    )
    error = (value[:, :-1] - target) ** 2
    metrics = {
        "j_c": episode_length * weighted_mean(signal[COST], weight),
        "value_loss": weighted_mean(error[REWARD], weight),
        "cost_value_loss": weighted_mean(error[COST], weight),
        "valid_fraction": jnp.mean(weight),
    }
    return batch, metrics


def split_rows(key: Key, rows: Any, num_minibatches: int) -> Any:
    """Rows in a fresh random order, cut into minibatches.

    Args:
      key: consumed.
      rows: pytree of [R, ...].
      num_minibatches: M, a divisor of R.

    Returns:
      Pytree of [M, R / M, ...].

    Raises:
      ValueError: while tracing, if M does not divide R.
    """
    num_rows = jax.tree.leaves(rows)[0].shape[0]
    if num_rows % num_minibatches:
        raise ValueError(
            f"the number of minibatches must divide the {num_rows} rows of an epoch, "
            f"got {num_minibatches}"
        )
    # One sort of 32 random bits: ties (1 in 500 rows' neighbours at most) keep their
    # order, which no statistic of a minibatch can see.
    order = jnp.argsort(jax.random.bits(key, (num_rows,)))
    return jax.tree.map(
        lambda leaf: leaf[order].reshape(num_minibatches, -1, *leaf.shape[1:]), rows
    )


def critic_optimizer(config: AgentConfig) -> optax.GradientTransformation:
    """Adam for both critics."""
    return optax.adam(config.value_lr)


def update_critics(
    config: AgentConfig,
    networks: Networks,
    params: Params,
    opt_state: Any,
    batch: Batch,
    key: Key,
) -> tuple[Params, Any, jax.Array]:
    """Both critics after `value_passes` x `value_minibatches` Adam steps.

        loss = mean (V_r - target_r)^2 + mean (V_c - target_c)^2

    Args:
      config: passes, minibatches, learning rate.
      networks: of the agent.
      params: stacked critic parameters.
      opt_state: Adam's state.
      batch: the epoch's rows.
      key: consumed; orders the minibatches.

    Returns:
      Parameters, Adam's state, and the gradient's norm at the first step.
    """
    optimizer = critic_optimizer(config)

    def loss_fn(params: Params, rows: tuple[jax.Array, jax.Array]) -> jax.Array:
        obs, rest = rows
        target, weight = rest[:, :2].T, rest[:, 2]
        value = networks.values(params, obs, config.critic_precision)
        return weighted_mean(jnp.sum((value - target) ** 2, axis=0), weight)

    def step(carry: tuple[Params, Any], rows: Any) -> tuple[tuple[Params, Any], Any]:
        params, opt_state = carry
        grads = mean_over_blocks(
            lambda rows: jax.grad(loss_fn)(params, rows), rows, rows[1][:, -1]
        )
        updates, opt_state = optimizer.update(grads, opt_state)
        params = optax.apply_updates(params, updates)
        return (params, opt_state), global_norm(grads)

    rows = (batch.obs, jnp.column_stack([batch.target, batch.weight]))

    def one_pass(carry: Any, key: Key) -> tuple[Any, jax.Array]:
        if config.value_minibatches == 1:
            return step(carry, rows)
        carry, norms = jax.lax.scan(
            step, carry, split_rows(key, rows, config.value_minibatches)
        )
        return carry, norms[0]

    keys = jax.random.split(key, config.value_passes)
    (params, opt_state), norms = jax.lax.scan(one_pass, (params, opt_state), keys)
    return params, opt_state, norms[0]


def global_norm(tree: Any) -> jax.Array:
    """Euclidean norm of all numbers of a pytree together."""
    return jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)))


def as_metrics(values: dict[str, Any]) -> Metrics:
    """All values as float32 scalars."""
    return {name: jnp.asarray(x, jnp.float32) for name, x in values.items()}
