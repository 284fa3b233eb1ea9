"""Advantages, critic targets and statistics weighted by validity.

A weight is 1 where a row counts and 0 from the row on at which its world failed.
"""

import chex
import jax
import jax.numpy as jnp

EPS = 1e-8  # keeps a constant advantage at 0 when it is divided by its std


def gae(
    reward: jax.Array,
    value: jax.Array,
    gamma: float | jax.Array,
    gae_lambda: float | jax.Array,
    valid: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Generalised advantages and discounted rewards-to-go, ended by a bootstrap.

        A_t = delta_t + gamma lambda A_{t+1},
        delta_t = r_t + gamma V(s_{t+1}) - V(s_t),
        target_t = r_t + gamma target_{t+1},  target_T = V(s_T)

    A world that fails at row t (valid 0 from there on) is cut there: A_t = 0 and
    target_t = V(s_t), so the rows before it bootstrap with V(s_t).

    Args:
      reward: [T, N] reward (or cost) received after acting in s_t.
      value: [T + 1, N] critic at s_0 ... s_T; the last row bootstraps the time limit.
      gamma: discount, in (0, 1].
      gae_lambda: bias-variance mix, in [0, 1].
      valid: [T, N] 1.0 where the row counts, else 0.0; all ones if None.

    Returns:
      advantage [T, N] and critic target [T, N] (not advantage + value).

    Raises:
      AssertionError: while tracing, if value is not one step longer than reward.

    Source: Schulman et al. 2016, section 3 (arXiv:1506.02438); targets as in
    openai/safety-starter-agents.
    """
    chex.assert_shape(value, (reward.shape[0] + 1, *reward.shape[1:]))
    alive = jnp.ones(reward.shape, bool) if valid is None else valid > 0
    delta = reward + gamma * value[1:] - value[:-1]

    def back(
        carry: tuple[jax.Array, jax.Array], row: tuple[jax.Array, ...]
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        advantage, target = carry
        reward_t, delta_t, value_t, alive_t = row
        advantage = jnp.where(alive_t, delta_t + gamma * gae_lambda * advantage, 0.0)
        target = jnp.where(alive_t, reward_t + gamma * target, value_t)
        return (advantage, target), (advantage, target)

    start = (jnp.zeros_like(delta[-1]), value[-1])
    rows = (reward, delta, value[:-1], alive)
    _, (advantage, target) = jax.lax.scan(back, start, rows, reverse=True, unroll=8)
    return advantage, target


def weighted_mean(x: jax.Array, weight: jax.Array) -> jax.Array:
    """Mean of x over all its elements with weight 1; 0 if there is none.

    Args:
      x: any shape; finite also where the weight is 0.
      weight: same shape, 0.0 or 1.0.

    Returns:
      Scalar.
    """
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1.0)


def normalise(advantage: jax.Array, weight: jax.Array) -> jax.Array:
    """(A - mean) / (population std + 1e-8) over the weighted elements, 0 elsewhere."""
    centred = centre(advantage, weight)
    std = jnp.sqrt(weighted_mean(centred**2, weight))
    return centred / (std + EPS)


def centre(advantage: jax.Array, weight: jax.Array) -> jax.Array:
    """A - mean over the weighted elements, 0 elsewhere; the scale is kept."""
    return (advantage - weighted_mean(advantage, weight)) * weight
