"""Constraints: what the robot must keep away from, and what it costs."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.records import Bodies, Layout


class Constraint(NamedTuple):
    """What must be avoided, as pure functions of where things stand.

    Attributes:
      objects: layout -> [M, 2] centres of the objects, which the intrinsic cost sees.
      radii: [M] their radii, metres.
      cost: (distances [M], bodies) -> [] extrinsic cost of the step.
    """

    objects: Callable[[Layout], jax.Array]
    radii: np.ndarray
    cost: Callable[[jax.Array, Bodies], jax.Array]


def distances_to(constraint: Constraint, layout: Layout) -> jax.Array:
    """[M] planar distances from the robot's origin to the centres, metres."""
    offset = constraint.objects(layout) - layout.robot_xy
    return jnp.sqrt((offset**2).sum(-1))


def make_constraint(config: EnvConfig) -> Constraint:
    """The sum over all constrained kinds of object, or 1 where it is positive.

    `constrain_indicator` chooses the latter, as Safety Gym's suite does.

    Source: openai/safety-gym engine.py, cost.
    """
    parts = [_KINDS[kind](config) for kind in config.constrained]
    ends = np.cumsum([len(part.radii) for part in parts])

    def objects(layout: Layout) -> jax.Array:
        return jnp.concatenate([part.objects(layout) for part in parts])

    def cost(distances: jax.Array, bodies: Bodies) -> jax.Array:
        shares = jnp.split(distances, ends[:-1])
        costs = [
            part.cost(share, bodies) for part, share in zip(parts, shares, strict=True)
        ]
        total = sum(costs[1:], costs[0])
        if config.constrain_indicator:
            return (total > 0).astype(total.dtype)
        return total

    radii = np.concatenate([part.radii for part in parts])
    return Constraint(objects, radii, cost)


def hazard_constraint(config: EnvConfig) -> Constraint:
    """Circles on the floor: only the robot's origin matters, not its body.

        cost = hazards_cost sum over hazards of max(0, R - d)

    Source: openai/safety-gym engine.py, cost; AutoCost (He et al. 2023), appendix.
    Differs: dense by default; equal to the paper's closest-hazard form while
    hazards do not overlap.
    """
    radius = config.hazards_size

    def cost(distances: jax.Array, bodies: Bodies) -> jax.Array:
        del bodies
        return config.hazards_cost * jnp.maximum(0.0, radius - distances).sum()

    return Constraint(
        lambda layout: layout.hazards, np.full(config.hazards_num, radius), cost
    )


def pillar_constraint(config: EnvConfig) -> Constraint:
    """Solid pillars: any part of the robot counts, the box does not.

        cost = pillars_cost 1[the robot touches a pillar]

    Source: openai/safety-gym engine.py, cost; AutoCost (He et al. 2023).
    Differs: Safety Gym counts contact points, whose number depends on the collision
    routine; with `constrain_indicator`, which its suite sets, the two are equal.
    """

    def cost(distances: jax.Array, bodies: Bodies) -> jax.Array:
        touches = bodies.pillar_contacts > 0
        return config.pillars_cost * touches.astype(distances.dtype)

    radii = np.full(config.pillars_num, config.pillars_size)
    return Constraint(lambda layout: layout.pillars, radii, cost)


def vase_constraint(config: EnvConfig) -> Constraint:
    """Vases that must be neither touched nor set moving.

        cost = vases_contact_cost (contact points with the robot)
             + vases_velocity_cost sum of speeds >= vases_velocity_threshold

    Source: openai/safety-gym engine.py, cost. The displacement cost, zero there by
    default, is not offered.
    """

    def cost(distances: jax.Array, bodies: Bodies) -> jax.Array:
        speed = _present(bodies.vases_speed)
        moving = jnp.where(speed >= config.vases_velocity_threshold, speed, 0.0).sum()
        touches = bodies.vase_contacts.astype(distances.dtype)
        return config.vases_contact_cost * touches + config.vases_velocity_cost * moving

    radii = np.full(config.vases_num, config.vases_size)
    return Constraint(lambda layout: _present(layout.vases), radii, cost)


def _present(array: jax.Array | None) -> jax.Array:
    """What only worlds with vases have."""
    if array is None:
        raise ValueError("there are no vases in this world")
    return array


_KINDS: dict[str, Callable[[EnvConfig], Constraint]] = {
    "hazards": hazard_constraint,
    "vases": vase_constraint,
    "pillars": pillar_constraint,
}
