"""Where a search begins: random costs of a set reach and loudness."""

import jax
import jax.numpy as jnp

from autocost_jax.config import THETA_SIZES, CostNetwork
from autocost_jax.costs import HIDDEN, intrinsic_logit
from autocost_jax.records import Key

QUIET_COST = 0.01  # where a cost begins to speak
QUIET_PLACES = (50.0, 64.0)  # percentiles of typical places at which it may begin
LOUD_PLACE = 85.0  # percentile at which its loudness is set
LOUD_COSTS = (0.12, 0.3)  # how loud it may be there
UNEVEN = 0.25  # relative deviation of a unit's weights: how much directions differ


def graded_start(
    key: Key,
    num: int,
    std: float,
    lidars: jax.Array,
    network: CostNetwork = "lidar_mlp",
    quiet_places: tuple[float, float] = QUIET_PLACES,
    loud_costs: tuple[float, float] = LOUD_COSTS,
    quiet_cost: float = QUIET_COST,
) -> jax.Array:
    """Random costs that rise as anything comes nearer; ours, not the paper's start.

    A hidden unit weighs all directions alike but for 25 % and turns on where one of the
    typical places has its readings; the output weights are |N(0, std^2)|. The output
    layer is scaled so that over all these places the cost is 0.01 at a percentile
    uniform in `quiet_places` (how far it reaches) and log-uniform in `loud_costs` at
    the 85th (how loud it is): from costs that hardly count to costs that make agents
    flee, see `experiments/starts.py`. Most of what N(0, std^2) draws is silent
    everywhere, or so loud that agents flee, or deaf in some direction.

    Args:
      key: consumed.
      num: P.
      std: scale of the parameters, before the output layer is scaled.
      lidars: [M, 8] readings at typical places.
      network: which network the parameters are of.
      quiet_places: percentiles, within [0, 85).
      loud_costs: lowest and highest, in (0, 1).
      quiet_cost: where a cost begins to speak, in (0, 1).

    Returns:
      theta [P, D].
    """
    key_parts, key_place, key_quiet, key_level = jax.random.split(key, 4)
    inner, outer = _random_parts(key_parts, num, std, network)
    index = jax.random.randint(key_place, (num, HIDDEN), 0, lidars.shape[0])
    places = _readings(lidars, network)[index]
    bias = -jnp.einsum("phb,pbh->ph", places, inner)
    logits = _logits(_join_parts(inner, bias, outer, jnp.zeros(num)), lidars)
    quiet = jax.random.uniform(
        key_quiet, (num,), minval=quiet_places[0], maxval=quiet_places[1]
    )
    low = jax.vmap(jnp.percentile)(logits, quiet)
    high = jnp.percentile(logits, LOUD_PLACE, axis=1)
    low_level, high_level = (jnp.log(cost) for cost in loud_costs)
    level = jax.random.uniform(key_level, (num,), minval=low_level, maxval=high_level)
    contrast = jnp.maximum(high - low, 0.01 * outer.sum(1))  # units may be all but off
    scale = (_logit(jnp.exp(level)) - _logit(quiet_cost)) / contrast
    last = _logit(quiet_cost) - scale * low
    return _join_parts(inner, bias, scale[:, None] * outer, last)


def _random_parts(
    key: Key, num: int, std: float, network: CostNetwork
) -> tuple[jax.Array, jax.Array]:
    """W1 [P, rows, 4] of about the mean of |N(0, std^2)|, and |W2| [P, 4] of it."""
    key_inner, key_outer = jax.random.split(key)
    rows = (THETA_SIZES[network] - 1 - 2 * HIDDEN) // HIDDEN
    uneven = UNEVEN * jax.random.normal(key_inner, (num, rows, HIDDEN))
    outer = jax.random.normal(key_outer, (num, HIDDEN))
    return 0.8 * std * jnp.abs(1.0 + uneven), std * jnp.abs(outer)


def _join_parts(
    inner: jax.Array, bias: jax.Array, outer: jax.Array, last: jax.Array
) -> jax.Array:
    """Theta [P, D] of its parts, the last one [P]."""
    parts = (inner.reshape(len(inner), -1), bias, outer, last[:, None])
    return jnp.concatenate(parts, axis=1)


def _readings(lidars: jax.Array, network: CostNetwork) -> jax.Array:
    """What the rows of W1 are multiplied with, [M, rows]."""
    return lidars if network == "lidar_mlp" else lidars.max(1, keepdims=True)


def _logits(theta: jax.Array, lidars: jax.Array) -> jax.Array:
    """[P, M] of theta [P, D] and lidars [M, 8]."""
    return jax.vmap(lambda theta: intrinsic_logit(theta, lidars))(theta)


def _logit(cost: jax.Array | float) -> jax.Array:
    return jnp.log(cost / (1 - jnp.asarray(cost)))
