"""Running normalisation of observations; ours, neither the paper's nor Safety Gym's.

The accelerometer reads 9.81 upwards and up to 30 sideways while a lidar bin is 0.05 on
average: without it the first layer of tanh units is saturated by gravity.
"""

import jax
import jax.numpy as jnp
from flax import struct

MIN_STD = 1e-2  # of a reading that hardly changes, such as gravity
MAX_ABS = 10.0  # of a normalised reading


class Normalizer(struct.PyTreeNode):
    """Mean and spread of all observations seen so far.

    Attributes:
      count: [] observations seen.
      mean: [O].
      square: [O] sum of squared distances from the mean.
    """

    count: jax.Array
    mean: jax.Array
    square: jax.Array


def init_normalizer(observation_size: int) -> Normalizer:
    """Nothing seen yet: observations pass as they are, but for the clip."""
    dtype = jnp.result_type(float)
    zeros = jnp.zeros(observation_size, dtype)
    return Normalizer(count=jnp.zeros((), dtype), mean=zeros, square=zeros)


def normalize_obs(normalizer: Normalizer, obs: jax.Array) -> jax.Array:
    """Observations [..., O] at mean 0 and deviation 1, within +-10."""
    variance = normalizer.square / jnp.maximum(normalizer.count, 1.0)
    std = jnp.where(normalizer.count > 0, jnp.sqrt(variance), 1.0)
    scaled = (obs - normalizer.mean) / jnp.maximum(std, MIN_STD)
    return jnp.clip(scaled, -MAX_ABS, MAX_ABS)


def update_normalizer(
    normalizer: Normalizer, obs: jax.Array, weight: jax.Array
) -> Normalizer:
    """Statistics with one more batch; Chan, Golub & LeVeque 1979.

    Args:
      normalizer: of what was seen before.
      obs: [..., O]; rows of weight 0 may hold anything, even NaN.
      weight: [...] 1.0 where the row counts, else 0.0.
    """
    axes = tuple(range(weight.ndim))
    weight = weight[..., None]
    obs = jnp.where(weight > 0, obs, 0.0)
    new = jnp.sum(weight)
    mean = jnp.sum(weight * obs, axes) / jnp.maximum(new, 1.0)
    square = jnp.sum(weight * (obs - mean) ** 2, axes)
    count = normalizer.count + new
    share = new / jnp.maximum(count, 1.0)
    shift = mean - normalizer.mean
    return Normalizer(
        count=count,
        mean=normalizer.mean + share * shift,
        square=normalizer.square + square + normalizer.count * share * shift**2,
    )
