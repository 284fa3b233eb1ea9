"""What the episodes of an epoch looked like, as numbers for people and fitness."""

import jax
import jax.numpy as jnp

from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.costs import intrinsic_cost
from autocost_jax.records import Metrics, Trajectory


def episode_metrics(
    trajectory: Trajectory, total: jax.Array, episode_length: int
) -> Metrics:
    """What one slot's episodes looked like, scalars.

    `ep_return`, `ep_cost` (extrinsic) and `ep_total_cost` (what the learner sees) are
    undiscounted episode sums, estimated as episode_length x the mean over valid steps:
    for whole episodes exactly their mean. `violating_worlds` is the share of worlds
    with an extrinsic cost > 0 in this epoch, `failed_worlds` their number.
    """
    cost, valid = trajectory.cost_inputs.cost, trajectory.valid
    world_cost = jnp.sum(valid * cost, axis=0)
    return {
        "ep_return": episode_length * weighted_mean(trajectory.reward, valid),
        "ep_cost": episode_length * weighted_mean(cost, valid),
        "ep_total_cost": episode_length * weighted_mean(total, valid),
        "violating_worlds": jnp.mean((world_cost > 0).astype(valid.dtype)),
        "failed_worlds": jnp.sum(1.0 - valid[-1]),
    }


def cost_by_distance(trajectory: Trajectory, theta: jax.Array) -> Metrics:
    """Mean intrinsic cost of visited states far from and near to constraint objects.

    `intrinsic_far` is over D > 3 R, `intrinsic_near` over D < 1.5 R; NaN if no such
    state was visited.
    """
    inputs = trajectory.cost_inputs
    cost = intrinsic_cost(theta, inputs.constraint_lidar)

    def mean(where: jax.Array) -> jax.Array:
        weight = trajectory.valid * where
        visited = jnp.sum(weight) > 0
        return jnp.where(visited, weighted_mean(cost, weight), jnp.nan)

    return {
        "intrinsic_far": mean(inputs.distance > 3.0 * inputs.radius),
        "intrinsic_near": mean(inputs.distance < 1.5 * inputs.radius),
    }
