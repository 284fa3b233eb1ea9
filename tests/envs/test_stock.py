"""Two of Safety Gym's own worlds, step by step as recorded: PointGoal1 and CarGoal1."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_data import NUM_WORLDS, float32_bound, load, stack, states_at

from autocost_jax.env_config import env_config
from autocost_jax.envs.env import Env, make_env
from autocost_jax.envs.sensors import lidar
from autocost_jax.records import Layout

FLOAT32 = 1e-5  # float32 against the engine's float64, design 6
# Design 6 allows the Point 0.1 in yaw rate and the Car 2e-2 in velocity.
STEP_QPOS, POINT_YAW_RATE, CAR_QVEL = 1e-4, 0.1, 1e-3
# d(accelerometer y) / d(yaw rate) = gear^2 kv com / inertia, about 65 / s.
ACCELEROMETER_PER_YAW_RATE = 70.0
CAR_ACCELEROMETER = 5e-3  # float32 of stiff contacts, spec 10.2
BINS_PER_RADIAN = 16 / (2 * np.pi)
VASE_DEPTH, VASE_SPEED = 1e-6, 1e-5  # float32; a vase moves from 1e-4 m/s on
# The Point's servo turns a last bit into 0.5 rad/s within tens of steps, so xy alone is
# compared there; its own versions of MuJoCo differ by 5e-3 m after 200 steps.
OPEN_LOOP_XY = 1e-2


class Recording(NamedTuple):
    """A recorded episode in world coordinates; states [T + 1], the rest [T]."""

    layout: Layout
    qpos: np.ndarray
    qvel: np.ndarray
    actions: np.ndarray
    obs: dict[str, np.ndarray]
    reward: np.ndarray
    cost: np.ndarray
    goal_met: np.ndarray

    @property
    def closest(self) -> np.ndarray:
        """[T + 1] distance to the closest hazard."""
        offset = self.layout.hazards - self.qpos[:, None, :2]
        return np.linalg.norm(offset, axis=-1).min(-1)


def read(robot: str) -> Recording:
    raw = load(f"env_{robot}Goal1_s1")
    names = raw["layout_names"].tolist()
    xy = {name: raw["layout_pos"][i, :2] for i, name in enumerate(names)}
    yaw = dict(zip(names, 2 * np.arctan2(*raw["layout_quat"].T[[3, 0]]), strict=True))
    hazards = [name for name in names if name.startswith("hazard")]
    layout = Layout(
        robot_xy=xy["robot"],
        robot_yaw=yaw["robot"],
        goal_xy=xy["goal"],
        hazards=np.stack([xy[name] for name in hazards]),
        pillars=np.zeros((0, 2)),
        box_xy=np.zeros(2),
        box_yaw=np.zeros(()),
        vases=xy["vase0"][None],
        vases_yaw=np.asarray(yaw["vase0"])[None],
    )
    qpos, qvel = raw["qpos"].copy(), raw["qvel"].copy()
    if robot == "Point":  # its slides start from, and point along, the layout's pose
        cos, sin = np.cos(yaw["robot"]), np.sin(yaw["robot"])
        turn = np.array([[cos, -sin], [sin, cos]])
        qpos[:, :2] = xy["robot"] + raw["qpos"][:, :2] @ turn.T
        qpos[:, 2] += yaw["robot"]
        qvel[:, :2] = raw["qvel"][:, :2] @ turn.T
    ends = np.cumsum(raw["obs_sizes"])
    parts = np.split(raw["obs"], ends[:-1], axis=1)
    return Recording(
        layout=layout,
        qpos=qpos,
        qvel=qvel,
        actions=raw["actions"],
        obs=dict(zip(raw["obs_keys"].tolist(), parts, strict=True)),
        reward=raw["reward"],
        cost=raw["costs"][:, 0],
        goal_met=raw["goal_met"],
    )


def step_all(env: Env, recording: Recording, tilt: float) -> Any:
    """One step from every recorded state, and what is wrong with it.

    The Car stands on the floor at distance 0 to within 1e-17, and by the rounding of
    the record its wheels touch but its caster does not. `tilt` makes it so: radians
    about its x axis, in the first state alone.
    """
    qpos = recording.qpos[:-1].copy()
    if qpos.shape[1] > 3 + 7:
        w, x, y, z = qpos[0, 3:7]
        qpos[0, 3:7] = np.array([w, x, y, z]) - tilt / 2 * np.array([-x, w, z, -y])
    states = states_at(env, recording.layout, qpos, recording.qvel[:-1])
    dtype = states.obs.dtype
    after = jax.jit(jax.vmap(env.step))(states, jnp.asarray(recording.actions, dtype))
    return after, {
        "qpos": np.abs(after.data.qpos - recording.qpos[1:]),
        "qvel": np.abs(after.data.qvel - recording.qvel[1:]),
        "reward": np.abs(after.reward - recording.reward),
        "cost": np.abs(after.cost - recording.cost),
        **{
            name: np.abs(after.obs[:, env.obs_slices[name]] - values[1:])
            for name, values in recording.obs.items()
        },
    }


def without_new_goals(errors: np.ndarray, recording: Recording) -> np.ndarray:
    """Errors of the goal lidar where it does not show a goal drawn anew."""
    return errors[~recording.goal_met]


# --- float32, as registered -----------------------------------------------------------


@pytest.fixture(scope="module")
def point():
    return read("Point")


@pytest.fixture(scope="module")
def car():
    return read("Car")


@pytest.fixture(scope="module")
def point_states(point_goal_1, point):
    """`reset_to` in the recorded layout, the robot moved to each recorded place."""
    layout = stack(point.layout, NUM_WORLDS)
    place = {"robot_xy": point.qpos[:-1, :2], "robot_yaw": point.qpos[:-1, 2]}
    layout = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), layout.replace(**place)
    )
    keys = jax.random.split(jax.random.key(0), NUM_WORLDS)
    return point_goal_1.reset_to(layout, keys)


def test_reset_to_shows_what_was_recorded(point_goal_1, point, point_states):
    bounds = {
        "goal_lidar": FLOAT32,
        "hazards_lidar": float32_bound(point.closest[:-1])[:, None],
        "magnetometer": FLOAT32,
        "vases_lidar": FLOAT32,
    }
    for name, bound in bounds.items():
        got = point_states.obs[:, point_goal_1.env.obs_slices[name]]
        assert (np.abs(got - point.obs[name][:-1]) <= bound).all(), name
    # The first recorded state is the reset itself.
    for name, part in point_goal_1.env.obs_slices.items():
        got = point_states.obs[0, part]
        np.testing.assert_allclose(got, point.obs[name][0], atol=FLOAT32)
    np.testing.assert_allclose(point_states.data.qpos[0], point.qpos[0], atol=FLOAT32)


def test_separate_cost_lidar(point, point_states):
    """The intrinsic network reads 8 exponential bins whatever the robot observes."""
    hazards = jnp.asarray(point.layout.hazards, jnp.float32)
    bodies = point_states.data.bodies
    expected = jax.vmap(
        lambda position, rotation: lidar(hazards, position, rotation, num_bins=8)
    )(bodies.robot, bodies.rotation)
    got = point_states.cost_inputs.constraint_lidar
    np.testing.assert_allclose(got, expected, atol=FLOAT32)
    assert got.shape == (NUM_WORLDS, 8)


def test_point_steps_match(point_goal_1, point):
    _, errors = step_all(point_goal_1.env, point, tilt=0.0)
    assert len(point.actions) == NUM_WORLDS
    assert not point.goal_met.any()
    assert point.cost.any()
    yaw, yaw_rate = errors["qpos"][:, 2, None], errors["qvel"][:, 2, None]
    bounds = {
        "qpos": np.array([*3 * [STEP_QPOS], *7 * [VASE_DEPTH]]),
        "qvel": np.array([*3 * [POINT_YAW_RATE], *6 * [VASE_SPEED]]),
        "reward": FLOAT32,
        "cost": 0.0,
        "accelerometer": 1e-2 + ACCELEROMETER_PER_YAW_RATE * yaw_rate,
        "gyro": FLOAT32 + yaw_rate,
        "velocimeter": FLOAT32 + 0.05 * yaw_rate + 2 * yaw,
        "magnetometer": FLOAT32 + yaw,
        "goal_lidar": FLOAT32 + BINS_PER_RADIAN * yaw,
        "vases_lidar": FLOAT32 + BINS_PER_RADIAN * yaw,
        "hazards_lidar": float32_bound(point.closest[1:])[:, None]
        + BINS_PER_RADIAN * yaw,
    }
    assert bounds.keys() == errors.keys()
    for name, bound in bounds.items():
        assert (errors[name] <= bound).all(), (name, errors[name].max())
    assert (yaw_rate < 1e-3).mean() >= 0.99  # design 6


def test_car_steps_match(car):
    """Every step, the first with the wheels on the floor as recorded."""
    after, errors = step_all(make_env("CarGoal1"), car, tilt=1e-6)
    assert car.goal_met.tolist() == [False] * 42 + [True]
    np.testing.assert_array_equal(after.metrics["goals_met"], car.goal_met)
    errors["goal_lidar"] = without_new_goals(errors["goal_lidar"], car)
    bounds = {
        "qpos": STEP_QPOS,
        "qvel": CAR_QVEL,
        "reward": FLOAT32,
        "cost": 0.0,
        "accelerometer": CAR_ACCELEROMETER,
        "ballangvel_rear": CAR_QVEL,
        "ballquat_rear": STEP_QPOS,
        "gyro": STEP_QPOS,
        "velocimeter": STEP_QPOS,
    }
    for name, error in errors.items():
        assert (error[1:] <= bounds.get(name, FLOAT32)).all(), (name, error[1:].max())
    print({k: (v[0].max(), v[1:].max()) for k, v in errors.items()})


# --- float64, full physics: what is left is rounding ------------------------------------
