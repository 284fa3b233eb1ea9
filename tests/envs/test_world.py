from typing import Any

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
import pytest
from env_data import NUM_WORLDS, blank_layout, load

from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.models import load_spec
from autocost_jax.envs.physics.world import make_world

mujoco: Any = untyped_mujoco  # its compiled names have no stubs

TABLE = 1e-9  # numbers printed with nine decimals
FLOAT64 = 1e-9  # float64 against float64; MuJoCo's own versions differ by 1e-13
STEP_QPOS = 1e-4  # float32 MJX over 10 substeps, design 6
# The yaw servo multiplies rounding by about -4 a substep: nearly all steps agree, and
# none is far off.
STEP_YAW_RATE, STEP_YAW_RATE_MAX, STEP_SHARE = 1e-3, 0.1, 0.99
TEN_STEPS_XY = 0.02  # design 6
# d(accelerometer y) / d(yaw rate) = gear^2 kv com / inertia, about 65 / s.
ACCELEROMETER_PER_YAW_RATE = 70.0
FORWARD_RUN = 1e-3  # float32 over up to 100 control steps


@pytest.fixture(scope="module")
def constants():
    return load("model_constants")


def c_model(floor: bool) -> Any:
    spec = load_spec("Point")
    if floor:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=[5, 5, 0.1], condim=6)
    return spec.compile()


def c_step(model, data, action, substeps=10):
    data.ctrl[:] = np.clip(action, -1, 1)
    for _ in range(substeps):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)


@pytest.mark.parametrize(
    "name",
    [
        "body_mass",
        "dof_damping",
        "dof_armature",
        "jnt_stiffness",
        "actuator_gear",
        "actuator_ctrlrange",
        "actuator_forcerange",
        "actuator_gainprm",
        "qpos0",
    ],
)
def test_constants_match_safety_gym(constants, name):
    got = getattr(c_model(floor=False), name)
    np.testing.assert_allclose(got, constants[f"Point_{name}"], rtol=1e-12)


def test_inertia_geoms_and_servo_match_safety_gym(constants):
    model = c_model(floor=True)
    # MuJoCo sorts principal inertias; their frame is tested by the motion.
    got = np.sort(model.body_inertia)
    np.testing.assert_allclose(got, np.sort(constants["Point_body_inertia"]), rtol=1e-9)
    # Biases beyond the third entry are unused.
    bias = constants["Point_actuator_biasprm"][:, :3]
    np.testing.assert_allclose(model.actuator_biasprm[:, :3], bias)
    np.testing.assert_allclose(model.geom_size[1:], constants["Point_geom_size"][1:])
    np.testing.assert_allclose(model.geom_pos, constants["Point_geom_pos"])
    np.testing.assert_allclose(model.geom_friction, constants["Point_geom_friction"])
    assert (model.nq, model.nv, model.nu) == (3, 3, 2)
    np.testing.assert_allclose(model.body_mass[1], 0.00518879020, atol=1e-11)
    np.testing.assert_allclose(model.body_ipos[1], [0.01927231514, 0, 0], atol=1e-11)
    assert model.opt.timestep == constants["Point_timestep"] == 0.002


def test_floor_never_acts(free_point):
    """The floor adds no constraint, and the trajectory without it is the same."""
    with_floor, without = c_model(floor=True), c_model(floor=False)
    data, bare = mujoco.MjData(with_floor), mujoco.MjData(without)
    for action in free_point["actions"]:
        c_step(with_floor, data, action)
        c_step(without, bare, action)
        assert data.nefc == bare.nefc == 0
        np.testing.assert_array_equal(data.qpos, bare.qpos)
        np.testing.assert_array_equal(data.qvel, bare.qvel)
    assert (free_point["nefc"] == 0).all()


def test_substeps_in_c_match_the_record(free_point):
    model = c_model(floor=False)
    data = mujoco.MjData(model)
    for step in range(100):
        data.qpos[:] = free_point["sub_qpos"][step]
        data.qvel[:] = free_point["sub_qvel"][step]
        c_step(model, data, free_point["actions"][step // 10], substeps=1)
        got = (data.qpos, data.qvel)
        expected = free_point["sub_qpos"][step + 1], free_point["sub_qvel"][step + 1]
        np.testing.assert_allclose(got, expected, atol=FLOAT64)


def test_golden_sensors_in_c():
    model = c_model(floor=False)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.1, -0.2, 0.5), (0.3, -0.1, 1.2)
    for action, accelerometer in [
        ((-0.4, 0.38), (-3.278090, 0.478785, 9.81)),
        ((0.03, -0.7), (1.347265, 15.754301, 9.81)),
    ]:
        data.ctrl[:] = action
        mujoco.mj_forward(model, data)
        got = data.sensor("accelerometer").data
        np.testing.assert_allclose(got, accelerometer, atol=1e-6)
    expected = {
        "velocimeter": (0.215332, -0.231586, 0),
        "gyro": (0, 0, 1.2),
        "magnetometer": (-0.239713, -0.438791, 0),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(data.sensor(name).data, value, atol=1e-6)


def closed_form(q, v, action, h=0.002):
    """One contact-free substep and the sensors before it, from the fact sheet."""
    m, c, inertia = 0.00518879020478639, 0.01927231514, 2.6494596e-5
    thrust = 0.3 * np.clip(action[0], -0.05, 0.05)
    torque = 0.3 * np.clip(action[1] - 0.3 * v[2], -0.05, 0.05)
    s, k, w = np.sin(q[2]), np.cos(q[2]), v[2]
    rows = [[m, 0, -m * c * s], [0, m, m * c * k]]
    mass = np.array([*rows, [-m * c * s, m * c * k, inertia + m * c * c]])
    damping = np.diag([0.01, 0.01, 0.005])
    along = thrust + m * c * w * w
    force = np.array([along * k, along * s, torque]) - damping @ v
    after = v + h * np.linalg.solve(mass + h * damping, force)
    turn = np.array([[k, s], [-s, k]])
    accelerometer = [*(turn @ np.linalg.solve(mass, force)[:2]), 9.81]
    return q + h * after, after, accelerometer, turn @ v[:2]


def test_one_substep_matches_closed_form_and_goldens():
    """MJX in float64, against the formula and the printed numbers."""
    golden = [  # q, v, action, q after, v after
        (
            (0, 0, 0),
            (0, 0, 0),
            (1, 1),
            (0.000011519, -0.000031557, 0.001643746),
            (0.005759495, -0.015778575, 0.821872867),
        ),
        (
            (0.1, -0.2, 0.5),
            (0.3, -0.1, 1.2),
            (-0.4, 0.38),
            (0.100587640, -0.200204619, 0.502395128),
            (0.293819769, -0.102309732, 1.197563936),
        ),
        (
            (0.1, -0.2, 0.5),
            (0.3, -0.1, 1.2),
            (0.03, -0.7),
            None,
            (0.291316348, -0.078505930, 0.046941923),
        ),
    ]
    rng = np.random.default_rng(0)
    num = 50
    q = np.concatenate([[g[0] for g in golden], rng.uniform(-3, 3, (num, 3))])
    v = np.concatenate([[g[1] for g in golden], rng.uniform(-2, 2, (num, 3))])
    action = np.concatenate([[g[2] for g in golden], rng.uniform(-1.2, 1.2, (num, 2))])
    with jax.enable_x64(True):
        config = EnvConfig(frameskip_binom_n=1)
        world, layout = make_world(config), blank_layout(config)

        @jax.jit
        @jax.vmap
        def step(q, v, action):
            start = world.place(layout).replace(qpos=q, qvel=v)
            data = world.control_step(start, layout, action)
            return data.qpos, data.qvel, world.sensors(data)

        got_q, got_v, sensors = jax.device_get(step(q, v, action))
    assert got_q.dtype == np.float64
    for row, (_, _, _, q_after, v_after) in enumerate(golden):
        if q_after is not None:
            np.testing.assert_allclose(got_q[row], q_after, atol=TABLE)
        np.testing.assert_allclose(got_v[row], v_after, atol=TABLE)
    for row in range(len(q)):
        clipped = np.clip(action[row], -1, 1)
        q_after, v_after, _, _ = closed_form(q[row], v[row], clipped)
        # The constants above carry ten digits; the unstable servo shows them.
        np.testing.assert_allclose(got_q[row], q_after, atol=1e-9)
        np.testing.assert_allclose(got_v[row], v_after, atol=1e-7)
        _, _, accelerometer, velocity = closed_form(q_after, v_after, clipped)
        np.testing.assert_allclose(
            sensors["accelerometer"][row], accelerometer, atol=1e-5
        )
        np.testing.assert_allclose(sensors["velocimeter"][row, :2], velocity, atol=1e-7)
        np.testing.assert_allclose(sensors["gyro"][row, 2], v_after[2], atol=1e-7)
        s, k = np.sin(q_after[2]), np.cos(q_after[2])
        magnetometer = (-0.5 * s, -0.5 * k, 0)
        np.testing.assert_allclose(
            sensors["magnetometer"][row], magnetometer, atol=1e-7
        )


@pytest.fixture(scope="module")
def single_steps(default_env, worlds, free_point):
    """The default environment one control step after every recorded state."""
    data = worlds.data.replace(
        qpos=jnp.asarray(free_point["qpos"][:-1], jnp.float32),
        qvel=jnp.asarray(free_point["qvel"][:-1], jnp.float32),
    )
    actions = jnp.asarray(free_point["actions"], jnp.float32)
    return default_env.step(worlds.replace(data=data), actions)


def assert_close_step(qpos, qvel, expected_qpos, expected_qvel):
    np.testing.assert_allclose(qpos, expected_qpos, atol=STEP_QPOS)
    error = np.abs(qvel - expected_qvel)
    assert error.max() < STEP_YAW_RATE_MAX
    assert (error[:, 2] < STEP_YAW_RATE).mean() >= STEP_SHARE


def test_one_control_step_matches_the_record(single_steps, free_point):
    data = single_steps.data
    expected = free_point["qpos"][1:], free_point["qvel"][1:]
    assert_close_step(data.qpos, data.qvel, *expected)


def test_one_control_step_matches_mujoco_c(single_steps, free_point):
    model = c_model(floor=False)
    data = mujoco.MjData(model)
    qpos, qvel = np.zeros((NUM_WORLDS, 3)), np.zeros((NUM_WORLDS, 3))
    for row in range(NUM_WORLDS):
        data.qpos[:] = np.float32(free_point["qpos"][row])
        data.qvel[:] = np.float32(free_point["qvel"][row])
        c_step(model, data, np.float32(free_point["actions"][row]))
        qpos[row], qvel[row] = data.qpos, data.qvel
    assert_close_step(single_steps.data.qpos, single_steps.data.qvel, qpos, qvel)


def test_sensors_after_one_step_match_the_record(default_env, single_steps, free_point):
    yaw_rate = np.abs(single_steps.data.qvel - free_point["qvel"][1:])[:, 2, None]
    allowed = {
        "accelerometer": 1e-2 + ACCELEROMETER_PER_YAW_RATE * yaw_rate,
        "gyro": 1e-5 + yaw_rate,
        "magnetometer": STEP_QPOS,
        "velocimeter": STEP_QPOS + 0.05 * yaw_rate,
    }
    for name, bound in allowed.items():
        got = single_steps.obs[:, default_env.env.obs_slices[name]]
        assert (np.abs(got - free_point[name][1:]) <= bound).all(), name


def test_ten_open_loop_steps_stay_close(default_env, worlds, free_point):
    starts = np.arange(NUM_WORLDS) % (len(free_point["actions"]) - 10)
    data = worlds.data.replace(
        qpos=jnp.asarray(free_point["qpos"][starts], jnp.float32),
        qvel=jnp.asarray(free_point["qvel"][starts], jnp.float32),
    )
    state = worlds.replace(data=data)
    for step in range(10):
        actions = jnp.asarray(free_point["actions"][starts + step], jnp.float32)
        state = default_env.step(state, actions)
    error = np.abs(state.data.qpos - free_point["qpos"][starts + 10])[:, :2]
    assert error.max() < TEN_STEPS_XY


def test_forward_run_and_turn_match_the_table(default_env, worlds):
    """From rest: full thrust, and full turn, in two halves of the batch."""
    data = worlds.data.replace(
        qpos=jnp.zeros((NUM_WORLDS, 3)), qvel=jnp.zeros((NUM_WORLDS, 3))
    )
    state = worlds.replace(data=data)
    drives = jnp.arange(NUM_WORLDS) % 2 == 0
    actions = jnp.where(drives[:, None], jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    drive = {
        1: (0.000626, 0.05661),
        10: (0.051445, 0.479023),
        50: (0.835387, 1.280864),
        100: (2.238293, 1.467986),
    }
    turn = {1: (0.044727, 2.87614), 10: (0.583749, 2.99842), 50: (2.982702, 2.99855)}
    for step in range(1, 101):
        state = default_env.step(state, actions)
        q, v = np.asarray(state.data.qpos), np.asarray(state.data.qvel)
        if step in drive:
            np.testing.assert_allclose(
                (q[0, 0], v[0, 0]), drive[step], atol=FORWARD_RUN
            )
        if step in turn:
            np.testing.assert_allclose((q[1, 2], v[1, 2]), turn[step], atol=FORWARD_RUN)
