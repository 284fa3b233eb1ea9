"""Car and Doggo against recordings of the original engine."""

import functools
from typing import Any

import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
import pytest
from env_data import NUM_WORLDS, Compiled, blank_layout, compile_env, load, states_at

from autocost_jax.config import EnvConfig, env_config
from autocost_jax.envs.physics.models import scene_model

mujoco: Any = untyped_mujoco  # its compiled names have no stubs

FLOAT64 = 1e-9  # MuJoCo's own versions differ by up to 1e-6 over 200 steps of a Doggo
OPEN_LOOP_C = 1e-5
# Share of control steps whose velocities agree; where a contact appears or not in the
# last digit they may differ by anything.
NEARLY_ALL, NEAR, ALMOST_ALL, CLOSE = 0.90, 1e-3, 0.98, 2e-2  # design 6
EXTREME = 0.97  # share of the steps with every motor at a limit; 0.98 is measured
OBSERVED = 1e-2  # 90 % of the rows of every sensor; the accelerometer in m/s^2


@functools.cache
def compiled(robot: str) -> Compiled:
    return compile_env(env_config(f"Goal-Hazard-{robot}"))


def steps_from(robot: str, before: dict[str, np.ndarray], actions: Any) -> Any:
    """The states [NUM_WORLDS] after one control step of MJX."""
    env, *_, step = compiled(robot)
    states = states_at(env, blank_layout(env.config), before["qpos"], before["qvel"])
    warmstart = jnp.asarray(before["qacc_warmstart"], jnp.float32)
    states = states.replace(data=states.data.replace(qacc_warmstart=warmstart))
    return step(states, jnp.asarray(actions, jnp.float32))


@pytest.mark.parametrize("robot", ["Car", "Doggo"])
def test_constants_match_safety_gym(robot):
    recorded = load("model_constants")
    model = scene_model(EnvConfig(robot=robot, hazards_num=1))
    for name in (
        "body_mass",
        "body_inertia",
        "dof_damping",
        "jnt_range",
        "jnt_stiffness",
        "qpos_spring",
        "actuator_gear",
        "actuator_forcerange",
        "qpos0",
    ):
        expected = recorded[f"{robot}_{name}"]
        got = getattr(model, name)[: len(expected)]
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-15, err_msg=name)
    assert model.opt.timestep == recorded[f"{robot}_timestep"]


@pytest.mark.parametrize("robot", ["Car", "Doggo"])
def test_the_scene_in_c_repeats_the_record(robot):
    recorded = load(f"free_{robot.lower()}_smooth")
    model = scene_model(EnvConfig(robot=robot, hazards_num=1))
    data = mujoco.MjData(model)
    for step, action in enumerate(recorded["actions"]):
        data.ctrl[:] = np.clip(action, -1, 1)
        for sub in range(10):
            mujoco.mj_step(model, data)
            index = 10 * step + sub + 1
            if index < len(recorded["sub_qpos"]):
                expected = recorded["sub_qpos"][index]
                np.testing.assert_allclose(data.qpos, expected, atol=FLOAT64)
        mujoco.mj_forward(model, data)
        expected = recorded["qpos"][step + 1]
        np.testing.assert_allclose(data.qpos, expected, atol=OPEN_LOOP_C)


# The Doggo's dynamics take a minute to compile; its rows are in test_rows.py.
DOGGO = pytest.param("Doggo", marks=pytest.mark.slow)


@pytest.mark.parametrize("robot", ["Car", DOGGO])
def test_control_steps_from_recorded_states(robot):
    """One control step from each of 200 recorded states: velocities and sensors."""
    recorded = load(f"free_{robot.lower()}_smooth")
    before = {name: recorded[name][:-1] for name in ("qpos", "qvel", "qacc_warmstart")}
    env = compiled(robot).env
    after = steps_from(robot, before, recorded["actions"])
    error = np.abs(after.data.qvel - recorded["qvel"][1:]).max(-1)
    assert np.mean(error < NEAR) >= NEARLY_ALL
    assert np.mean(error < CLOSE) >= ALMOST_ALL
    start = 0
    sizes = zip(recorded["obs_keys"].tolist(), recorded["obs_sizes"], strict=True)
    for key, size in sizes:
        expected = recorded["obs"][1:, start : start + size]
        got = np.asarray(after.obs[:, env.obs_slices[key]])
        assert got.shape == expected.shape, key
        error = np.abs(got - expected).max(-1)
        assert np.quantile(error, NEARLY_ALL) < OBSERVED, key
        start += size


def extreme_actions(kind: str, size: int) -> np.ndarray:
    """[NUM_WORLDS, size] of one run, every motor at a limit."""
    shape = (NUM_WORLDS, size)
    if kind == "ahead":
        return np.ones(shape)
    if kind == "back":
        return -np.ones(shape)
    drawn = np.random.default_rng(0).choice([-1.0, 1.0], (NUM_WORLDS // 10, size))
    return np.repeat(drawn, 10, axis=0)


@pytest.mark.parametrize("kind", ["ahead", "back", "bang-bang"])
@pytest.mark.parametrize("robot", ["Point", "Car", DOGGO])
def test_control_steps_under_extreme_actions(robot, kind):
    """A control step of MJX from each state of a run of the scene in C.

    A Doggo with all motors ahead rests on its hind hips, its hind shanks crossed. The
    first step is left out: all starts at distance 0 from the floor, where the last bit
    decides what touches.
    """
    model = scene_model(env_config(f"Goal-Hazard-{robot}"))
    data = mujoco.MjData(model)
    actions = extreme_actions(kind, model.nu)
    runs: dict[str, list[np.ndarray]] = {
        name: [] for name in ("qpos", "qvel", "qacc_warmstart")
    }
    after: list[np.ndarray] = []
    for action in actions:
        for name, values in runs.items():
            values.append(getattr(data, name).copy())
        data.ctrl[:] = action
        mujoco.mj_step(model, data, nstep=10)
        after.append(data.qvel.copy())
    before = {name: np.array(values) for name, values in runs.items()}
    got = steps_from(robot, before, actions).data.qvel
    error = np.abs(got - np.array(after)).max(-1)[1:]
    assert np.mean(error < NEAR) >= EXTREME
