"""What each world lets its robot see: names, order and sizes; nothing is stepped."""

import dataclasses

import pytest

from autocost_jax.config import ENVS, SUITE
from autocost_jax.envs.env import make_env

# As Safety Gym flattens them, sorted by name; a lidar has as many numbers as bins.
LIDAR = 0
POINT = {
    "accelerometer": 3,
    "box_lidar": LIDAR,
    "goal_lidar": LIDAR,
    "gyro": 3,
    "hazards_lidar": LIDAR,
    "magnetometer": 3,
    "pillars_lidar": LIDAR,
    "vases_lidar": LIDAR,
    "velocimeter": 3,
}
CAR = {
    "accelerometer": 3,
    "ballangvel_rear": 3,
    "ballquat_rear": 9,
    "box_lidar": LIDAR,
    "goal_lidar": LIDAR,
    "gyro": 3,
    "hazards_lidar": LIDAR,
    "magnetometer": 3,
    "pillars_lidar": LIDAR,
    "vases_lidar": LIDAR,
    "velocimeter": 3,
}
DOGGO = {
    "accelerometer": 3,
    "box_lidar": LIDAR,
    "goal_lidar": LIDAR,
    "gyro": 3,
    "hazards_lidar": LIDAR,
    "jointpos_ankle_1": 2,
    "jointpos_ankle_2": 2,
    "jointpos_ankle_3": 2,
    "jointpos_ankle_4": 2,
    "jointpos_hip_1_y": 2,
    "jointpos_hip_1_z": 2,
    "jointpos_hip_2_y": 2,
    "jointpos_hip_2_z": 2,
    "jointpos_hip_3_y": 2,
    "jointpos_hip_3_z": 2,
    "jointpos_hip_4_y": 2,
    "jointpos_hip_4_z": 2,
    "jointvel_ankle_1": 1,
    "jointvel_ankle_2": 1,
    "jointvel_ankle_3": 1,
    "jointvel_ankle_4": 1,
    "jointvel_hip_1_y": 1,
    "jointvel_hip_1_z": 1,
    "jointvel_hip_2_y": 1,
    "jointvel_hip_2_z": 1,
    "jointvel_hip_3_y": 1,
    "jointvel_hip_3_z": 1,
    "jointvel_hip_4_y": 1,
    "jointvel_hip_4_z": 1,
    "magnetometer": 3,
    "pillars_lidar": LIDAR,
    "touch_ankle_1a": 1,
    "touch_ankle_1b": 1,
    "touch_ankle_2a": 1,
    "touch_ankle_2b": 1,
    "touch_ankle_3a": 1,
    "touch_ankle_3b": 1,
    "touch_ankle_4a": 1,
    "touch_ankle_4b": 1,
    "vases_lidar": LIDAR,
    "velocimeter": 3,
}
ROBOTS = {"Point": POINT, "Car": CAR, "Doggo": DOGGO}
ACTIONS = {"Point": 2, "Car": 2, "Doggo": 12}
SIZES_8 = {  # all lidars with 8 bins
    ("Goal", "Point"): 28,
    ("Goal", "Car"): 40,
    ("Goal", "Doggo"): 72,
    ("Push", "Point"): 36,
    ("Push", "Car"): 48,
    ("Push", "Doggo"): 80,
}
SIZES_16 = {
    ("Goal", "Point"): 44,
    ("Goal", "Car"): 56,
    ("Goal", "Doggo"): 88,
    ("Push", "Point"): 60,
    ("Push", "Car"): 72,
    ("Push", "Doggo"): 104,
}
SIZES_SUITE = {
    ("Goal", "Point"): 60,
    ("Goal", "Car"): 72,
    ("Goal", "Doggo"): 104,
    ("Push", "Point"): 76,
    ("Push", "Car"): 88,
    ("Push", "Doggo"): 120,
}


def assert_sees(env, robot: str, lidars: list[str], num_bins: int, size: int) -> None:
    start, expected = 0, {}
    for name, width in ROBOTS[robot].items():
        if width != LIDAR or name in lidars:
            end = start + (num_bins if width == LIDAR else width)
            expected[name] = slice(start, end)
            start = end
    assert dict(env.obs_slices) == expected
    assert list(env.obs_slices) == list(expected)
    assert env.observation_size == start == size
    assert env.action_size == ACTIONS[robot]


@pytest.mark.parametrize("num_bins", [8, 16])
@pytest.mark.parametrize("name", ENVS)
def test_the_worlds_of_the_paper(name, num_bins):
    task, constraint, robot = name.replace("8", "").split("-")
    env = make_env(dataclasses.replace(ENVS[name], lidar_num_bins=num_bins))
    lidars = ["goal_lidar", f"{constraint.lower()}s_lidar"]
    lidars += ["box_lidar"] if task == "Push" else []
    size = (SIZES_8 if num_bins == 8 else SIZES_16)[task, robot]
    assert_sees(env, robot, lidars, num_bins, size)
    assert (env.config.name == name) == (num_bins == 8)


@pytest.mark.parametrize("name", SUITE)
def test_the_suite(name):
    config = SUITE[name]
    goal = ["goal_lidar", "hazards_lidar", "vases_lidar"]
    push = ["box_lidar", "goal_lidar", "hazards_lidar", "pillars_lidar"]
    lidars = goal if config.task == "Goal" else push
    size = SIZES_SUITE[config.task, config.robot]
    assert name == f"{config.robot}{config.task}{name[-1]}"
    assert_sees(make_env(name), config.robot, lidars, 16, size)


def test_control_periods():
    """0.02, 0.04, 0.1 s, and 1000 steps per episode."""
    periods = {"Point": 0.02, "Car": 0.04, "Doggo": 0.1}
    for robot, period in periods.items():
        env = make_env(f"Goal-Hazard-{robot}")
        assert env.dt == pytest.approx(period)
        assert env.episode_length == 1000
