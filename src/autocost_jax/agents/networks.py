"""Policy and critic networks, and the Gaussian that the policy parametrises.

Safety Gym's starter agents: tanh layers, linear outputs, Glorot-uniform kernels,
zero biases, a free log standard deviation. Densities and divergences carry the same
1e-8 as theirs.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from autocost_jax.config import AgentConfig, Precision
from autocost_jax.precision import full_precision
from autocost_jax.records import Key

Params = Any
EPS = 1e-8  # of the starter agents: added to positive standard deviations
REWARD, COST = 0, 1  # positions on the critics' leading axis


class Networks(NamedTuple):
    """An agent's networks as pure functions.

    Attributes:
      init: key -> (policy parameters, critic parameters stacked on an axis of 2).
      distribution: (policy parameters, obs [..., O]) -> (mean [..., U], log_std [U]).
      values: (critic parameters, obs [..., O], precision="float32") -> [2, ...],
        reward and cost value; see `AgentConfig.critic_precision`.
    """

    init: Callable[[Key], tuple[Params, Params]]
    distribution: Callable[[Params, jax.Array], tuple[jax.Array, jax.Array]]
    values: Callable[..., jax.Array]


class Mlp(nn.Module):
    """tanh layers of `hidden_sizes`, then a linear layer of `output_size`.

    The hidden layers compute in `hidden_dtype`, the output in that of the parameters.
    Its weights begin at `output_scale` times Glorot's.
    """

    hidden_sizes: tuple[int, ...]
    output_size: int
    param_dtype: Any
    hidden_dtype: Any = None
    output_scale: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Outputs [..., output_size] for inputs x [..., I]."""

        def dense(size: int, dtype: Any, scale: float = 1.0) -> nn.Dense:
            glorot = nn.initializers.variance_scaling(scale**2, "fan_avg", "uniform")
            return nn.Dense(
                size, kernel_init=glorot, param_dtype=self.param_dtype, dtype=dtype
            )

        for size in self.hidden_sizes:
            x = nn.tanh(dense(size, self.hidden_dtype)(x))
        if self.hidden_dtype is not None:
            x = x.astype(self.param_dtype)
        return dense(self.output_size, None, self.output_scale)(x)


class GaussianPolicy(nn.Module):
    """Diagonal Gaussian: a network for the mean, a free vector for the log std."""

    hidden_sizes: tuple[int, ...]
    action_size: int
    log_std_init: float
    param_dtype: Any
    output_scale: float = 1.0

    @nn.compact
    def __call__(self, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean [..., U] and log_std [U] for obs [..., O]."""
        mlp = Mlp(
            self.hidden_sizes,
            self.action_size,
            self.param_dtype,
            output_scale=self.output_scale,
            name="mean",
        )
        log_std = self.param(
            "log_std",
            nn.initializers.constant(self.log_std_init),
            (self.action_size,),
            self.param_dtype,
        )
        return mlp(obs), log_std


def make_networks(
    config: AgentConfig, observation_size: int, action_size: int
) -> Networks:
    """The networks of one agent, in JAX's default float type.

    Args:
      config: sizes of the hidden layers; the policy's first log std and output scale.
      observation_size: O.
      action_size: U.

    Returns:
      Pure functions; the two critics share nothing but the call.
    """
    dtype = jnp.result_type(float)
    policy = GaussianPolicy(
        config.hidden_sizes,
        action_size,
        config.log_std_init,
        dtype,
        config.policy_output_scale,
    )
    critic = Mlp(config.hidden_sizes, 1, dtype)
    critic_bfloat16 = critic.clone(hidden_dtype=jnp.bfloat16)
    dummy = jnp.zeros((1, observation_size), dtype)

    def init(key: Key) -> tuple[Params, Params]:
        key_policy, key_critic = jax.random.split(key)
        policy_params = policy.init(key_policy, dummy)["params"]
        critic_params = jax.vmap(lambda k: critic.init(k, dummy)["params"])(
            jax.random.split(key_critic, 2)
        )
        return policy_params, critic_params

    def distribution(params: Params, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
        output: Any = policy.apply({"params": params}, obs)
        return output

    def values(
        params: Params, obs: jax.Array, precision: Precision = "float32"
    ) -> jax.Array:
        network = critic_bfloat16 if precision == "bfloat16" else critic

        def value(one: Params) -> jax.Array:
            output: Any = network.apply({"params": one}, obs)
            return jnp.squeeze(output, -1)

        products = "tensorfloat32" if precision == "tensorfloat32" else "highest"
        with jax.default_matmul_precision(products):
            return jax.vmap(value)(params)

    return Networks(init, full_precision(distribution), values)


def sample(key: Key, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Actions mean + std * noise, unclipped.

    Args:
      key: consumed.
      mean: [..., U].
      log_std: [U].

    Returns:
      Actions [..., U].
    """
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return mean + jnp.broadcast_to(jnp.exp(log_std), mean.shape) * noise


def log_prob(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log density of actions under the Gaussian, summed over its dimensions.

        log p(a) = sum_i -1/2 [((a_i - mu_i) / (std_i + 1e-8))^2 + 2 ln std_i + ln 2pi]

    Args:
      action: [..., U].
      mean: [..., U].
      log_std: [U].

    Returns:
      [...].

    Source: openai/safety-starter-agents, gaussian_likelihood.
    """
    log_std = jnp.broadcast_to(log_std, mean.shape)
    scaled = (action - mean) / (jnp.exp(log_std) + EPS)
    return -0.5 * jnp.sum(scaled**2 + 2.0 * log_std + math.log(2 * math.pi), axis=-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Differential entropy sum_i (ln std_i + 1/2 ln 2 pi e) of log_std [..., U]."""
    return jnp.sum(log_std + 0.5 * math.log(2 * math.pi * math.e), axis=-1)


def kl_divergence(
    mean: jax.Array,
    log_std: jax.Array,
    old_mean: jax.Array,
    old_log_std: jax.Array,
) -> jax.Array:
    """KL(new || old) of each state, summed over the action dimensions.

        sum_i 1/2 [((mu_old - mu)^2 + std^2) / (std_old^2 + 1e-8) - 1]
              + ln std_old - ln std

    Args:
      mean: [..., U] of the new policy.
      log_std: [U] of the new policy.
      old_mean: [..., U].
      old_log_std: [U].

    Returns:
      [...], nats; slightly negative values are rounding.

    Source: openai/safety-starter-agents, diagonal_gaussian_kl.
    """
    shape = mean.shape
    inverse = jnp.broadcast_to(1.0 / (jnp.exp(2.0 * old_log_std) + EPS), shape)
    # What does not depend on the state is formed once, not once a row.
    ratio = jnp.exp(2.0 * log_std) / (jnp.exp(2.0 * old_log_std) + EPS)
    constant = jnp.sum(0.5 * (ratio - 1.0) + old_log_std - log_std)
    return constant + 0.5 * jnp.sum((old_mean - mean) ** 2 * inverse, axis=-1)
