"""What a cost says of places around a robot, as NumPy arrays for pictures."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import LIDAR_BINS
from autocost_jax.costs import intrinsic_cost
from autocost_jax.envs.sensors import lidar
from autocost_jax.population import run_compiled

Array = np.ndarray[Any, Any]


@jax.vmap
def _see(place: jax.Array) -> jax.Array:
    return lidar(place[None], jnp.zeros(3), jnp.eye(3), num_bins=LIDAR_BINS)


def object_lidar(ego_xy: Array) -> Array:
    """The constraint lidar of a single object.

    Args:
      ego_xy: [..., 2] the object's centre in the robot frame, metres.

    Returns:
      [..., 8] readings in [0, 1]; several objects combine by their maximum.
    """
    places = np.asarray(ego_xy, np.float32).reshape(-1, 2)
    seen = np.asarray(run_compiled(_see, places))
    return seen.reshape(*np.shape(ego_xy)[:-1], LIDAR_BINS)


def network_cost(theta: Array, lidar: Array) -> Array:
    """`costs.intrinsic_cost` [...] of theta [D] and readings [..., 8]."""
    return np.asarray(run_compiled(intrinsic_cost, theta, lidar), float)
