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
    with an extrinsic cost > 0 in this epoch, of those that made a valid step;
    `failed_worlds` is the number of those that failed. What none has shown is NaN.
    """
    cost, valid = trajectory.cost_inputs.cost, trajectory.valid
    violating = (jnp.sum(valid * cost, axis=0) > 0).astype(valid.dtype)
    return {
        "ep_return": episode_length * mean_of(trajectory.reward, valid),
        "ep_cost": episode_length * mean_of(cost, valid),
        "ep_total_cost": episode_length * mean_of(total, valid),
        "violating_worlds": mean_of(violating, valid[0]),
        "failed_worlds": jnp.sum(1.0 - valid[-1]),
    }


def mean_of(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Mean of all elements with weight 1; NaN if there is none, unlike a learner's."""
    known = jnp.sum(weight) > 0
    return jnp.where(known, weighted_mean(values, weight), jnp.nan)


def cost_by_distance(trajectory: Trajectory, theta: jax.Array) -> Metrics:
    """Mean intrinsic cost of visited states far from and near to constraint objects.

    `intrinsic_far` is over D > 3 R, `intrinsic_near` over D < 1.5 R; NaN if no such
    state was visited.
    """
    inputs = trajectory.cost_inputs
    cost = intrinsic_cost(theta, inputs.constraint_lidar)

    valid, far, near = trajectory.valid, 3.0 * inputs.radius, 1.5 * inputs.radius
    return {
        "intrinsic_far": mean_of(cost, valid * (inputs.distance > far)),
        "intrinsic_near": mean_of(cost, valid * (inputs.distance < near)),
    }
