"""Two of Safety Gym's own worlds, step by step as recorded: PointGoal1 and CarGoal1."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
import pytest
from env_data import NUM_WORLDS, float32_bound, load, stack, states_at

from autocost_jax.config import env_config
from autocost_jax.envs.env import Env, make_env
from autocost_jax.envs.physics.models import scene_model
from autocost_jax.envs.sensors import lidar
from autocost_jax.records import EnvState, Layout

mujoco: Any = untyped_mujoco  # its compiled names have no stubs
Step = Callable[[EnvState, jax.Array], EnvState]

pytestmark = pytest.mark.optimised

FLOAT32 = 1e-5  # float32 against the engine's float64, design 6
# Design 6 allows the Point 0.1 in yaw rate and the Car 2e-2 in velocity.
STEP_QPOS, POINT_YAW_RATE, CAR_QVEL = 1e-4, 0.1, 5e-4
# d(accelerometer y) / d(yaw rate) = gear^2 kv com / inertia, about 65 / s.
ACCELEROMETER_PER_YAW_RATE = 70.0
CAR_ACCELEROMETER = 2e-3  # stiff contacts; spec 10.2 has 5e-3
BINS_PER_RADIAN = 16 / (2 * np.pi)
VASE_QPOS, VASE_QVEL = 1e-6, 1e-5  # a vase counts as moving from 1e-4 m/s on
LIFT = 1e-6  # metres; see `lifted_step`
# The Point's servo turns a last bit into 0.5 rad/s within tens of steps, so xy alone is
# compared; versions of MuJoCo differ by 5e-3 m after 200 steps.
TEN_STEPS_XY, OPEN_LOOP_XY = 2e-3, 1e-2
CAR_OPEN_LOOP = 2e-4  # measured 2e-5
OPEN_LOOP_64 = 1e-6


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


def _numpy_layout(**arrays: Any) -> Layout:
    return Layout(**arrays)


def read(robot: str) -> Recording:
    raw = load(f"env_{robot}Goal1_s1")
    names = raw["layout_names"].tolist()
    xy = {name: raw["layout_pos"][i, :2] for i, name in enumerate(names)}
    yaw = dict(zip(names, 2 * np.arctan2(*raw["layout_quat"].T[[3, 0]]), strict=True))
    hazards = [name for name in names if name.startswith("hazard")]
    layout = _numpy_layout(
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


def compare(env: Env, recording: Recording, after: EnvState) -> dict[str, np.ndarray]:
    """What is wrong with one step from every recorded state."""
    after = jax.device_get(after.replace(key=None))  # JAX would round it to float32
    observed = {
        name: np.abs(after.obs[:, env.obs_slices[name]] - values[1:])
        for name, values in recording.obs.items()
    }
    # A goal that was met is drawn anew, from other random numbers.
    observed["goal_lidar"][recording.goal_met] = 0.0
    return {
        "qpos": np.abs(after.data.qpos - recording.qpos[1:]),
        "qvel": np.abs(after.data.qvel - recording.qvel[1:]),
        "reward": np.abs(after.reward - recording.reward),
        "cost": np.abs(after.cost - recording.cost),
        **observed,
    }


def assert_within(errors: dict[str, np.ndarray], bounds: dict[str, Any]) -> None:
    assert bounds.keys() == errors.keys()
    for name, bound in bounds.items():
        worst = errors[name].max()
        assert (errors[name] <= bound).all(), f"{name}: {worst}"


def drift(step: Step, states: EnvState, recording: Recording, num_steps: int) -> Any:
    """Open loop from every recorded state at once.

    Returns:
      errors of qpos [num_steps, T, nq] and of xy; zero where the record is over.
    """
    num = len(recording.actions)
    actions = jnp.asarray(recording.actions, states.obs.dtype)
    errors = []
    for ahead in range(num_steps):
        rows = np.minimum(np.arange(num) + ahead, num - 1)
        states = step(states, actions[rows])
        error = np.abs(states.data.qpos - recording.qpos[rows + 1])
        errors.append(np.where((np.arange(num) + ahead < num)[:, None], error, 0.0))
    return np.stack(errors)


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


@pytest.fixture(scope="module")
def point_starts(point_goal_1, point):
    return states_at(point_goal_1.env, point.layout, point.qpos[:-1], point.qvel[:-1])


def test_point_steps_match(point_goal_1, point, point_starts):
    assert len(point.actions) == NUM_WORLDS
    assert not point.goal_met.any()
    assert point.cost.any()
    after = point_goal_1.step(point_starts, point.actions)
    errors = compare(point_goal_1.env, point, after)
    yaw, yaw_rate = errors["qpos"][:, 2, None], errors["qvel"][:, 2, None]
    assert (yaw_rate < 1e-3).mean() >= 0.99  # design 6
    turned = BINS_PER_RADIAN * yaw
    bounds = {
        "qpos": np.array([*3 * [STEP_QPOS], *7 * [VASE_QPOS]]),
        "qvel": np.array([*3 * [POINT_YAW_RATE], *6 * [VASE_QVEL]]),
        "reward": FLOAT32,
        "cost": 0.0,
        "accelerometer": 1e-2 + ACCELEROMETER_PER_YAW_RATE * yaw_rate,
        "gyro": FLOAT32 + yaw_rate,
        "velocimeter": FLOAT32 + 0.05 * yaw_rate + 2 * yaw,
        "magnetometer": FLOAT32 + yaw,
        "goal_lidar": FLOAT32 + turned,
        "vases_lidar": FLOAT32 + turned,
        "hazards_lidar": float32_bound(point.closest[1:])[:, None] + turned,
    }
    assert_within(errors, bounds)


def test_point_open_loop(point_goal_1, point, point_starts):
    errors = drift(point_goal_1.step, point_starts, point, 50)
    assert errors[:10, :, :2].max() < TEN_STEPS_XY
    assert errors[:, :, :2].max() < OPEN_LOOP_XY
    assert errors[:, :, 3:].max() < VASE_QPOS


@pytest.fixture(scope="module")
def car_env():
    env = make_env("CarGoal1")
    return env, jax.jit(jax.vmap(env.step))


@pytest.fixture(scope="module")
def car_starts(car_env, car):
    """The recorded states, the first one lifted; see `lifted_step`."""
    qpos = car.qpos[:-1].copy()
    qpos[0, 2] += LIFT
    return states_at(car_env[0], car.layout, qpos, car.qvel[:-1])


def lifted_step(car: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The first step of the Car by MuJoCo C, from `LIFT` above the recorded state.

    The Car starts at distance 0 from the floor to within 1e-17: by the rounding of the
    record its wheels touch and its caster does not, which changes the first step by
    6 cm of wheel rotation. Lifted, nothing touches, here and there.
    """
    model = scene_model(env_config("CarGoal1"))
    data = mujoco.MjData(model)
    for lift in (0.0, LIFT):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = car.qpos[0], car.qvel[0]
        data.qpos[2] += lift
        data.ctrl[:] = np.clip(car.actions[0], -1, 1)
        mujoco.mj_step(model, data, nstep=10)
        if lift == 0.0:  # the reference is the engine that was recorded
            np.testing.assert_allclose(data.qpos, car.qpos[1], atol=1e-9)
    return data.qpos.copy(), data.qvel.copy()


def car_errors(car: Recording, env: Env, after: EnvState) -> dict[str, np.ndarray]:
    """As `compare`, the first step against MuJoCo C in place of the record."""
    errors = compare(env, car, after)
    after = jax.device_get(after.replace(key=None))
    qpos, qvel = lifted_step(car)
    first = {
        "qpos": np.abs(after.data.qpos[0] - qpos),
        "qvel": np.abs(after.data.qvel[0] - qvel),
    }
    return {
        name: np.concatenate([first.get(name, 0 * error[0])[None], error[1:]])
        for name, error in errors.items()
    }


@pytest.mark.slow  # the Car's own steps: tests/envs/test_robots.py
def test_car_steps_match(car_env, car, car_starts):
    env, step = car_env
    after = step(car_starts, jnp.asarray(car.actions, jnp.float32))
    assert car.goal_met.tolist() == [False] * 42 + [True]
    np.testing.assert_array_equal(after.metrics["goals_met"], car.goal_met)
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
        "magnetometer": FLOAT32,
        "goal_lidar": FLOAT32,
        "vases_lidar": FLOAT32,
        "hazards_lidar": FLOAT32,
    }
    errors = car_errors(car, env, after)
    assert_within(errors, bounds)


@pytest.mark.slow
def test_car_open_loop(car_env, car, car_starts):
    _, step = car_env
    errors = drift(step, car_starts, car, 41)[:, 1:]
    assert errors.max() < CAR_OPEN_LOOP


# --- full physics ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["Point", "Car"])
def test_full_physics_in_float64_leaves_rounding(robot):
    recording = read(robot)
    config = dataclasses.replace(env_config(f"{robot}Goal1"), physics="full")
    with jax.enable_x64(True):
        env = make_env(config)
        reset = jax.jit(env.reset_to)(recording.layout, jax.random.key(0))
        qpos = recording.qpos[:-1].copy()
        qpos[0, 2] += LIFT * (robot == "Car")
        starts = states_at(env, recording.layout, qpos, recording.qvel[:-1])
        step = jax.jit(jax.vmap(env.step))
        after = step(starts, jnp.asarray(recording.actions))
        adrift = drift(step, starts, recording, 41)
    assert reset.obs.dtype == np.float64
    for name, part in env.obs_slices.items():
        if (robot, name) == ("Car", "accelerometer"):
            continue  # see `lifted_step`
        np.testing.assert_allclose(reset.obs[part], recording.obs[name][0], atol=1e-12)
    if robot == "Car":
        errors = car_errors(recording, env, after)
    else:
        errors = compare(env, recording, after)
    # MuJoCo's solver stops at 1e-8 of its own measure, ours after fixed iterations.
    loose = ("qvel", "accelerometer", "ballangvel_rear", "gyro")
    bounds = {name: 2e-4 if name in loose else 2e-6 for name in errors}
    assert_within(errors, bounds if robot == "Car" else dict.fromkeys(errors, 1e-8))
    if robot == "Car":
        assert adrift[:, 1:].max() < OPEN_LOOP_64  # the first start is lifted
    else:
        assert adrift[:5].max() < OPEN_LOOP_64
        assert adrift[:, :, :2].max() < OPEN_LOOP_XY
