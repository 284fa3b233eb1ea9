"""The records that flow through the library, and the legend of their axes.

Axes, used in every docstring of the package:

    A  algorithms        P  slots (one agent each)   N  worlds of a slot
    T  steps             O  observation              U  action
    H  hazards           Q  pillars                  V  vases
    B  lidar bins (8)    M  objects of a list
    D  parameters of the cost (41 or 13)             K  terms of the cost bank

Lengths are metres, angles radians, times seconds.
"""

from typing import Any

import jax
from flax import struct

Key = jax.Array
Metrics = dict[str, jax.Array]


def root_key(seed: int) -> Key:
    """The key of a seed, of JAX's own generator whatever the user's default is.

    Under `vmap` others draw what depends on the lanes beside: the candidates of a stage
    would not meet the same layouts.
    """
    return jax.random.key(seed, impl="threefry2x32")


class Layout(struct.PyTreeNode):
    """Where everything stands at the start of an episode, world frame.

    Attributes:
      robot_xy: [2] robot origin.
      robot_yaw: [] heading of the robot, counter-clockwise from +x.
      goal_xy: [2] centre of the goal.
      hazards: [H, 2] hazard centres.
      pillars: [Q, 2] pillar centres.
      box_xy: [2] box centre; zeros where the task has no box.
      box_yaw: [] heading of the box; zero where the task has no box.
      vases: [V, 2] vase centres; None without vases, which only Safety Gym's own
        suite has.
      vases_yaw: [V] headings of the vases; None without.
    """

    robot_xy: jax.Array
    robot_yaw: jax.Array
    goal_xy: jax.Array
    hazards: jax.Array
    pillars: jax.Array
    box_xy: jax.Array
    box_yaw: jax.Array
    vases: jax.Array | None = None
    vases_yaw: jax.Array | None = None


class Bodies(struct.PyTreeNode):
    """Where the movable bodies are and what they touch, read from the physics.

    Attributes:
      robot: [3] origin of the robot, world frame.
      rotation: [3, 3] robot body to world.
      box: [3] centre of the box; zeros where the task has no box.
      box_yaw: [] heading of the box.
      pillar_contacts: [] int32 contact points between robot and pillars.
      vase_contacts: [] int32 contact points between robot and vases.
      vases: [V, 3] vase centres; None without vases.
      vases_yaw: [V] headings of the vases; None without.
      vases_speed: [V] speeds of the vases' centres, m/s; None without.
    """

    robot: jax.Array
    rotation: jax.Array
    box: jax.Array
    box_yaw: jax.Array
    pillar_contacts: jax.Array
    vase_contacts: jax.Array
    vases: jax.Array | None = None
    vases_yaw: jax.Array | None = None
    vases_speed: jax.Array | None = None


class PhysicsState(struct.PyTreeNode):
    """The physics of one world between two control steps.

    A state is set by replacing `qpos` and `qvel`; the rest follows in the next step.

    Attributes:
      qpos: [nq] robot, box (7), vases (7 each); see `mj_model`.
      qvel: [nv] likewise, 6 for each free body.
      ctrl: [U] the last action, clipped.
      qacc_warmstart: [nv] where the constraint solver starts.
      sensordata: raw sensor readings in the order of the robot's XML.
      time: [] seconds since the reset.
      bodies: positions and contacts of this very state.
    """

    qpos: jax.Array
    qvel: jax.Array
    ctrl: jax.Array
    qacc_warmstart: jax.Array
    sensordata: jax.Array
    time: jax.Array
    bodies: Bodies


class CostInputs(struct.PyTreeNode):
    """What a training cost may look at, all of the post-step state.

    Attributes:
      cost: [...] extrinsic cost of the step.
      constraint_lidar: [..., B] the 8-bin lidar of the hazards or pillars, in [0, 1].
      distance: [...] planar distance, robot origin to the closest constraint centre.
      previous_distance: [...] the same one step earlier (at reset: `distance`).
      radius: [...] radius of that closest object.
    """

    cost: jax.Array
    constraint_lidar: jax.Array
    distance: jax.Array
    previous_distance: jax.Array
    radius: jax.Array


class EnvState(struct.PyTreeNode):
    """One world between two steps.

    Attributes:
      data: the physics, a `PhysicsState`; `step` reads the physical state here alone.
      layout: where things stand now; `goal_xy` moves when a goal is met.
      obs: [O] observation.
      reward: [] reward of the last step.
      cost: [] extrinsic cost of the last step.
      done: [] bool, True exactly at the time limit.
      failed: [] bool, True from the first non-finite number until the next reset.
      age: [] int32 steps since the reset.
      task_distances: [...] the task's distances that the next reward starts from.
      cost_inputs: what a training cost may look at.
      metrics: counters since the reset: `goals_met`, `goal_move_failures`,
        `distance_travelled` (metres), `steps_outside` the arena.
      key: source of later goal moves.
    """

    data: Any
    layout: Layout
    obs: jax.Array
    reward: jax.Array
    cost: jax.Array
    done: jax.Array
    failed: jax.Array
    age: jax.Array
    task_distances: jax.Array
    cost_inputs: CostInputs
    metrics: Metrics
    key: Key


class Trajectory(struct.PyTreeNode):
    """What one epoch of rollouts leaves behind.

    Attributes:
      obs: [T + 1, N, O] observations; the last row bootstraps the time limit.
      action: [T, N, U] actions as sampled, unclipped.
      reward: [T, N] rewards received after acting in obs[t].
      cost_inputs: fields [T, N, ...], of the state after the action.
      valid: [T, N] 1.0 where the row counts, 0.0 once its world has failed.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    cost_inputs: CostInputs
    valid: jax.Array


class TrainingCost(struct.PyTreeNode):
    """The cost a learner sees, as data, so that slots can differ in it.

    Attributes:
      weights: [K] weight of each term of the cost bank.
      theta: [D] parameters of the intrinsic cost network.
      limit: [] allowed cost per episode (undiscounted sum).
    """

    weights: jax.Array
    theta: jax.Array
    limit: jax.Array


class Slot(struct.PyTreeNode):
    """One agent to train, as data.

    Attributes:
      cost: its training cost and limit.
      key: root of all its random numbers.
      constrained: [] float32; 0 turns PPO-Lagrangian into plain PPO.
    """

    cost: TrainingCost
    key: Key
    constrained: jax.Array


class EvalResult(struct.PyTreeNode):
    """Whole episodes of a fixed policy.

    Attributes:
      ep_return: [E] undiscounted return of each episode.
      ep_cost: [E] extrinsic cost of each episode.
      distance_travelled: [E] path length of each episode, metres.
      outside_share: [E] share of the steps outside the arena.
      valid: [E] 1.0 where no number of the episode was non-finite.
      violation_rate: [] share of valid episodes with `ep_cost` > 0; NaN without any.
    """

    ep_return: jax.Array
    ep_cost: jax.Array
    distance_travelled: jax.Array
    outside_share: jax.Array
    valid: jax.Array
    violation_rate: jax.Array
