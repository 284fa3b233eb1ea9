"""What is wrong with a cost, in sentences made of its numbers."""

import numpy as np

from autocost_jax.viz.cost_map import Array, network_cost, object_lidar
from autocost_jax.viz.markup import number

# Over 1000 steps 0.01 adds up to 10, more than the extrinsic cost of a fresh agent,
# and driving with care does not avoid it: it only drives agents out of the arena.
LOUD_FAR = 0.01
# Closer than 1.5 radii R the extrinsic cost of a hazard is 0.15 R on average, 0.05 for
# Safety Gym's. A cost must at least double that to be heard.
SPEAKS_NEAR = 0.1
# An agent that turns its quiet side to an obstacle pays less than half.
QUIET_SIDE = 0.5
SIDE_DISTANCE = 1.5  # radii: where the sides are compared, the rim of "near"
BEARINGS, QUARTER = 144, 36  # bearings around the robot; those of a 90-degree side
SIDES = ("ahead of it", "on its left", "behind it", "on its right")
AXES = tuple(f"towards {axis} of its frame" for axis in ("+x", "+y", "−x", "−y"))


def describe_cost(
    theta: Array,
    radius: float,
    far: float,
    near: float,
    *,
    obstacle: str = "hazard",
    heading: float | None = None,
) -> list[str]:
    """Sentences that name the faults of a cost, or say that it has none of these.

    Args:
      theta: [D] parameters of the network.
      radius: of the obstacle, metres.
      far: mean cost per step over visited states more than 3 radii away; NaN: unknown.
      near: the same closer than 1.5 radii.
      obstacle: what to call it.
      heading: direction that is ahead in the robot's frame, radians from its x axis;
        None: unknown, sides are named by axes.
    """
    sentences = []
    loud, quiet = side_costs(theta, SIDE_DISTANCE * radius, heading)
    if loud[0] > LOUD_FAR and quiet[0] < QUIET_SIDE * loud[0]:
        sentences.append(
            f"One-sided: loud on one side of the robot only. With a {obstacle} "
            f"{loud[1]} it says {number(loud[0])} per step, with one at the same "
            f"distance {quiet[1]} only {number(quiet[0])}."
        )
    if far > LOUD_FAR:
        sentences.append(
            f"Loud everywhere: {number(far)} per step far from {obstacle}s. No way of "
            f"driving avoids that, so agents flee or give up the goal."
        )
    if near < SPEAKS_NEAR:
        sentences.append(
            f"Silent: it hardly speaks next to a {obstacle}, {number(near)} per step."
        )
    if np.isnan(near):
        sentences.append(
            f"Unknown close by: its agents never came near a {obstacle} at the end of "
            "their training."
        )
    if np.isnan(far):
        sentences.append(
            f"Unknown far away: its agents were never far from every {obstacle}."
        )
    return sentences or [
        f"Quiet far from {obstacle}s ({number(far)} per step), speaks close by "
        f"({number(near)} per step), and on every side of the robot."
    ]


def side_costs(
    theta: Array, distance: float, heading: float | None = None
) -> tuple[tuple[float, str], tuple[float, str]]:
    """The loudest and the quietest side of the robot, as (mean cost, side in words).

    A side is a quarter of all bearings around one of four directions, so that it holds
    two whole bins of the lidar, within which the reading of one object varies.

    Args:
      theta: [D] parameters of the network.
      distance: of a single obstacle's centre, metres.
      heading: direction that is ahead in the robot's frame, radians from its x axis;
        None: unknown, sides are named by axes.
    """
    start, names = (0.0, AXES) if heading is None else (heading, SIDES)
    bearing = start + 2 * np.pi * (np.arange(BEARINGS) + 0.5) / BEARINGS
    ego = distance * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    cost = np.roll(network_cost(theta, object_lidar(ego)), QUARTER // 2)
    means = cost.reshape(len(SIDES), QUARTER).mean(1)
    loud, quiet = int(np.argmax(means)), int(np.argmin(means))
    return (float(means[loud]), names[loud]), (float(means[quiet]), names[quiet])
