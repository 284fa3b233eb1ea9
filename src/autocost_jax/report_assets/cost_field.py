"""The evolved cost in NumPy, for pictures: independent of the JAX implementation."""

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

LIDAR_BINS = 8
HIDDEN = 4
THETA_SIZES = tuple(rows * HIDDEN + HIDDEN + HIDDEN + 1 for rows in (LIDAR_BINS, 1))


def object_lidar(ego_xy: Array) -> Array:
    """The 8-bin exponential lidar (gain 1) of a single object.

    Args:
      ego_xy: [..., 2] the object's centre in the robot frame, metres.

    Returns:
      [..., 8] readings in [0, 1]; several objects combine by their maximum.

    Source: openai/safety-gym engine.py, obs_lidar_pseudo, with aliasing.
    """
    x, y = np.moveaxis(np.asarray(ego_xy, float), -1, 0)
    strength = np.exp(-np.hypot(x, y))
    position = np.mod(np.arctan2(y, x), 2 * np.pi) / (2 * np.pi / LIDAR_BINS)
    index = np.floor(position).astype(int)
    alias = position - index
    bins = np.arange(LIDAR_BINS)

    def at(shift: int, value: Array) -> Array:
        hit = (index[..., None] + shift) % LIDAR_BINS == bins
        return np.where(hit, value[..., None], 0.0)

    own, above, below = (
        at(0, strength),
        at(1, alias * strength),
        at(-1, (1 - alias) * strength),
    )
    return np.maximum(own, np.maximum(above, below))


def network_cost(theta: Array, lidar: Array) -> Array:
    """The intrinsic cost of a step, a network of 8-4-1 units.

        c = sigmoid(W2 . sigmoid(W1 l + b1) + b2)

    With one row in W1 the highest reading is the only input.

    Args:
      theta: [41] W1 row-major 8 x 4, b1, W2, b2; or [13] with a W1 of 1 x 4.
      lidar: [..., 8] readings in [0, 1].

    Returns:
      [...] cost in (0, 1).
    """
    theta = np.asarray(theta, float)
    end = len(theta) - HIDDEN - 1
    w1, b1 = theta[: end - HIDDEN].reshape(-1, HIDDEN), theta[end - HIDDEN : end]
    if len(w1) == 1:
        lidar = np.max(lidar, axis=-1, keepdims=True)
    return _sigmoid(_sigmoid(lidar @ w1 + b1) @ theta[end:-1] + theta[-1])


def _sigmoid(x: Array) -> Array:
    return 0.5 * (1 + np.tanh(x / 2))  # does not overflow for steep networks
