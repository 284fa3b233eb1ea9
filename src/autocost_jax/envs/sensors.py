"""What the robot perceives: the pseudo-lidar and the flat observation."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np


def lidar(
    targets: jax.Array,
    position: jax.Array,
    rotation: jax.Array,
    *,
    num_bins: int,
    max_dist: float | None = None,
    exp_gain: float = 1.0,
    alias: bool = True,
) -> jax.Array:
    """Closeness of the nearest target in each sector around the robot.

        e = R^T ((x, y, 0) - position), planar part;  d = |e|;  u = n atan2(e) / 2 pi
        s = exp(-gain d)   or, with a maximal distance D,   max(0, D - d) / D
        bin floor(u) reads s; aliasing adds frac(u) s to the next bin and
        (1 - frac(u)) s to the previous one; bins take the maximum over targets

    Args:
      targets: [H, 2] target centres, world frame, metres.
      position: [3] robot origin, world frame, metres.
      rotation: [3, 3] body to world.
      num_bins: n; sector 0 starts at the robot's +x axis, counter-clockwise.
      max_dist: D in metres; None for the exponential law.
      exp_gain: gain of the exponential law, 1 / metres.
      alias: whether neighbouring bins are lit too.

    Returns:
      [n] readings in [0, 1]; 0 where nothing is seen.

    Source: openai/safety-gym engine.py, obs_lidar_pseudo and ego_xy.
    Differs: the bin is taken modulo n, where the original fails on an angle of -1e-17.
    """
    offset = jnp.pad(targets, ((0, 0), (0, 1))) - position
    # Elementwise on purpose: a matrix product could run in TF32 on a GPU.
    ego_x = (offset * rotation[:, 0]).sum(-1)
    ego_y = (offset * rotation[:, 1]).sum(-1)
    dist = jnp.sqrt(ego_x**2 + ego_y**2)
    if max_dist is None:
        reading = jnp.exp(-exp_gain * dist)
    else:
        reading = jnp.maximum(0.0, max_dist - dist) / max_dist
    angle = jnp.mod(jnp.arctan2(ego_y, ego_x), 2 * np.pi)
    sector = angle / (2 * np.pi / num_bins)
    index = jnp.floor(sector)
    # How far each bin lies ahead of the target's own bin, [H, n].
    bins = jnp.arange(num_bins)
    ahead = (bins - index.astype(bins.dtype)[:, None]) % num_bins
    lit = jnp.where(ahead == 0, reading[:, None], 0.0)
    if alias:
        share = (sector - index)[:, None]
        after = jnp.where(ahead == 1 % num_bins, share * reading[:, None], 0.0)
        before = jnp.where(
            ahead == (num_bins - 1), (1.0 - share) * reading[:, None], 0.0
        )
        lit = jnp.maximum(lit, jnp.maximum(after, before))
    return lit.max(0, initial=0.0)


def flatten(parts: Mapping[str, jax.Array]) -> jax.Array:
    """The parts of an observation one behind the other, in sorted order of names.

    Source: openai/safety-gym engine.py, obs with observation_flatten.
    """
    return jnp.concatenate([parts[name].ravel() for name in sorted(parts)])


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Where `flatten` puts each part, in sorted order of names."""
    names = sorted(sizes)
    ends = np.cumsum([sizes[name] for name in names])
    return {
        name: slice(int(end) - sizes[name], int(end))
        for name, end in zip(names, ends, strict=True)
    }
