"""Car, Doggo, a pillar and the box against recordings of the original engine."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
import pytest
from env_data import blank_layout, load, states_at

from autocost_jax.config import EnvConfig, env_config
from autocost_jax.envs.env import make_env
from autocost_jax.envs.physics.models import scene_model

mujoco: Any = untyped_mujoco  # its compiled names have no stubs

FLOAT64 = 1e-9  # MuJoCo's own versions differ by up to 1e-6 over 200 steps of a Doggo
OPEN_LOOP_C = 1e-5
# Share of control steps whose velocities agree; where a contact appears or not in the
# last digit they may differ by anything.
NEARLY_ALL, NEAR, ALMOST_ALL, CLOSE = 0.90, 1e-3, 0.98, 2e-2  # design 6
OBSERVED = 1e-2  # 90 % of the rows of every sensor; the accelerometer in m/s^2
ONSET_XY = 5e-3


def one_pillar() -> EnvConfig:
    config = env_config("Goal-Pillar-Point")
    return dataclasses.replace(config, pillars_num=1, lidar_num_bins=16)


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


@pytest.mark.parametrize("robot", ["Car", "Doggo"])
def test_control_steps_from_recorded_states(robot):
    """One control step from each of 200 recorded states: velocities and sensors."""
    recorded = load(f"free_{robot.lower()}_smooth")
    env = make_env(f"Goal-Hazard-{robot}")
    layout = blank_layout(env.config)
    states = states_at(env, layout, recorded["qpos"][:-1], recorded["qvel"][:-1])
    warmstart = jnp.asarray(recorded["qacc_warmstart"][:-1], jnp.float32)
    states = states.replace(data=states.data.replace(qacc_warmstart=warmstart))
    actions = jnp.asarray(recorded["actions"], jnp.float32)
    after = jax.jit(jax.vmap(env.step))(states, actions)
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


def test_pillar_is_touched_when_the_record_says():
    recorded = load("pillar_head_on")
    config = one_pillar()
    env = make_env(config)
    layout = blank_layout(
        config, pillars=recorded["pillar"][None], goal_xy=np.array([9.0, 9.0])
    )
    action = jnp.asarray(recorded["action"], jnp.float32)

    def drive(state, _):
        state = env.step(state, action)
        return state, (state.data.qpos, state.cost)

    state = env.reset_to(layout, jax.random.key(0))
    run = jax.jit(lambda state: jax.lax.scan(drive, state, None, 300)[1])
    qpos, cost = run(state)
    assert recorded["contact"][1:].any()
    np.testing.assert_array_equal(cost, recorded["cost_indicator"][1:])
    np.testing.assert_allclose(qpos[:, :2], recorded["qpos"][1:, :2], atol=ONSET_XY)


def test_box_is_pushed_as_recorded_until_shortly_after_contact():
    recorded = load("push_point_straight")
    config = dataclasses.replace(env_config("Push-Hazard-Point"), hazards_num=1)
    env = make_env(config)
    layout = blank_layout(
        config,
        hazards=np.array([[9.0, 9.0]]),
        goal_xy=recorded["goal"],
        box_xy=recorded["box0"],
        box_yaw=recorded["box_rot0"],
    )
    assert float(env.mj_model.body("box").mass[0]) == pytest.approx(
        float(recorded["box_mass"])
    )
    onset = int(np.argmax(recorded["robot_box_contacts"] > 0))
    steps = onset + 3
    action = jnp.asarray(recorded["action"], jnp.float32)

    def push(state, _):
        state = env.step(state, action)
        return state, (state.data.qpos, state.reward)

    state = env.reset_to(layout, jax.random.key(0))
    run = jax.jit(lambda state: jax.lax.scan(push, state, None, steps)[1])
    qpos, reward = run(state)
    assert 0 < onset < 100
    moved = np.abs(np.asarray(qpos[:, 3:5]) - recorded["box0"]).max(-1)
    assert (moved[: onset - 1] < 1e-4).all()
    assert moved[-1] > 1e-3
    expected = recorded["qpos"][1 : steps + 1]
    np.testing.assert_allclose(qpos[:, :2], expected[:, :2], atol=ONSET_XY)
    np.testing.assert_allclose(qpos[:, 3:5], expected[:, 3:5], atol=2 * ONSET_XY)
    np.testing.assert_allclose(
        reward[: onset - 1], recorded["reward"][1:onset], atol=1e-5
    )
