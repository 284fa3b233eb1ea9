"""Constraints: what the robot must keep away from, and what it costs."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.config import EnvConfig
from autocost_jax.records import Layout


class Constraint(NamedTuple):
    """What must be avoided, as pure functions of where things stand.

    Attributes:
      lidar_name: name of the lidar that sees the objects.
      radius: radius of one object, metres.
      objects: layout -> [H, 2] centres of the objects.
      cost: [H] distances -> [] extrinsic cost of the step.
    """

    lidar_name: str
    radius: float
    objects: Callable[[Layout], jax.Array]
    cost: Callable[[jax.Array], jax.Array]


def distances_to(constraint: Constraint, layout: Layout) -> jax.Array:
    """[H] planar distances from the robot's origin to the centres, metres."""
    offset = constraint.objects(layout) - layout.robot_xy
    return jnp.sqrt((offset**2).sum(-1))


def hazard_constraint(config: EnvConfig) -> Constraint:
    """Circles on the floor: only the robot's origin matters, not its body.

        cost = hazards_cost sum over hazards of max(0, R - d)

    With `constrain_indicator`, 1 where that sum is positive.

    Source: openai/safety-gym engine.py, cost; AutoCost (He et al. 2023), appendix.
    Differs: dense by default; equal to the paper's closest-hazard form while
    hazards do not overlap.
    """
    radius = config.hazards_size

    def cost(distance: jax.Array) -> jax.Array:
        dense = config.hazards_cost * jnp.maximum(0.0, radius - distance).sum()
        if config.constrain_indicator:
            return (dense > 0).astype(dense.dtype)
        return dense

    def objects(layout: Layout) -> jax.Array:
        return layout.hazards

    return Constraint("hazards_lidar", radius, objects, cost)
