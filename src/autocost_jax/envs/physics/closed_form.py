"""The Point where nothing can touch it: equations of motion in place of an engine.

A body with two slides and a hinge has a 3 x 3 mass matrix that can be inverted by hand.
One substep equals MuJoCo's to rounding, at a fraction of the operations.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.models import mujoco, physics_model
from autocost_jax.envs.physics.world import World, make_readings
from autocost_jax.records import Bodies, Layout, PhysicsState

Motion = tuple[jax.Array, jax.Array]  # qpos [3], qvel [3]


class _Point(NamedTuple):
    """The numbers of the compiled model; floats, in SI units.

    Attributes:
      mass, inertia: of the whole robot, about its centre of mass.
      offset: centre of mass ahead of the origin, along body x.
      height: of the origin.
      damping: of x, y and heading.
      gear, low, high: of thrust and turn; the limits act before the gear.
      gain: of the turning servo.
      gravity: downwards.
      field: [3] magnetic flux in the world.
      timestep: of a substep.
    """

    mass: float
    inertia: float
    offset: float
    height: float
    damping: tuple[float, float, float]
    gear: tuple[float, float]
    low: tuple[float, float]
    high: tuple[float, float]
    gain: float
    gravity: float
    field: tuple[float, float, float]
    timestep: float


def make_closed_form_world(config: EnvConfig) -> World:
    """The world of a contact-free Point; see `World`."""
    mj_model = physics_model(config).mj_model
    point = _read(mj_model)
    num_substeps = config.frameskip_binom_n
    dtype = jnp.zeros(()).dtype

    def place(layout: Layout) -> PhysicsState:
        qpos = jnp.concatenate([layout.robot_xy, layout.robot_yaw[None]]).astype(dtype)
        zero = jnp.zeros((), dtype)
        return _observe(point, (qpos, jnp.zeros_like(qpos)), jnp.zeros(2, dtype), zero)

    def control_step(
        state: PhysicsState, layout: Layout, action: jax.Array
    ) -> PhysicsState:
        del layout  # nothing stands in the way
        ctrl = jnp.clip(action.astype(dtype), -1.0, 1.0)
        motion = (state.qpos, state.qvel)
        for _ in range(num_substeps):  # unrolled, so that it becomes one kernel
            motion = _substep(point, ctrl, motion)
        time = state.time + num_substeps * point.timestep
        return _observe(point, motion, ctrl, time)

    sensors, sizes = make_readings(mj_model)
    return World(
        mj_model=mj_model,
        place=place,
        control_step=control_step,
        sensors=sensors,
        sensor_sizes=sizes,
        action_size=int(mj_model.nu),
        dt=num_substeps * point.timestep,
        dtype=dtype,
    )


def _read(mj_model: Any) -> _Point:
    """What the equations need of a compiled model."""
    robot = mj_model.body("robot")
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, robot.iquat)
    inertia = rotation.reshape(3, 3) @ np.diag(robot.inertia) @ rotation.reshape(3, 3).T
    low, high = mj_model.actuator_forcerange.T
    thrust, turn = mj_model.actuator_gear[0, 0], mj_model.actuator_gear[1, 0]
    return _Point(
        mass=float(robot.mass[0]),
        inertia=float(inertia[2, 2]),
        offset=float(robot.ipos[0]),
        height=float(robot.pos[2]),
        damping=tuple(mj_model.dof_damping.tolist()),
        gear=(float(thrust), float(turn)),
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        gain=float(mj_model.actuator_gainprm[1, 0]),
        gravity=-float(mj_model.opt.gravity[2]),
        field=tuple(mj_model.opt.magnetic.tolist()),
        timestep=float(mj_model.opt.timestep),
    )


def _acceleration(
    point: _Point, ctrl: jax.Array, motion: Motion, timestep: float
) -> jax.Array:
    """[3] accelerations of x, y and heading, damping implicit over `timestep`.

    Solves (M + timestep B) a = f for the mass matrix M, damping B and forces f.
    """
    heading, (vx, vy, spin) = motion[0][2], motion[1]
    sin, cos = jnp.sin(heading), jnp.cos(heading)
    thrust = point.gear[0] * jnp.clip(ctrl[0], point.low[0], point.high[0])
    servo = point.gain * (ctrl[1] - point.gear[1] * spin)
    torque = point.gear[1] * jnp.clip(servo, point.low[1], point.high[1])
    moment = point.mass * point.offset
    ahead = thrust + moment * spin * spin
    force_x = ahead * cos - point.damping[0] * vx
    force_y = ahead * sin - point.damping[1] * vy
    torque = torque - point.damping[2] * spin
    mass = point.mass + timestep * point.damping[0]
    inertia = point.inertia + moment * point.offset + timestep * point.damping[2]
    turning = torque + moment / mass * (sin * force_x - cos * force_y)
    turning = turning / (inertia - moment * moment / mass)
    x = (force_x + moment * sin * turning) / mass
    y = (force_y - moment * cos * turning) / mass
    return jnp.stack([x, y, turning])


def _substep(point: _Point, ctrl: jax.Array, motion: Motion) -> Motion:
    """MuJoCo's semi-implicit Euler step."""
    qpos, qvel = motion
    step = point.timestep
    qvel = qvel + step * _acceleration(point, ctrl, motion, step)
    return qpos + step * qvel, qvel


def _observe(
    point: _Point, motion: Motion, ctrl: jax.Array, time: jax.Array
) -> PhysicsState:
    """The state that `motion` is, with its sensors in the order of the model.

    An accelerometer feels gravity's opposite; all sensors sit at the robot's origin.
    """
    qpos, qvel = motion
    x, y, heading = qpos
    sin, cos = jnp.sin(heading), jnp.cos(heading)
    zero = jnp.zeros_like(x)

    def turned(vector_x: jax.Array, vector_y: jax.Array) -> tuple[jax.Array, jax.Array]:
        return cos * vector_x + sin * vector_y, cos * vector_y - sin * vector_x

    felt = _acceleration(point, ctrl, motion, 0.0)
    field = jnp.asarray(point.field, x.dtype)
    sensordata = [
        *turned(felt[0], felt[1]),
        zero + point.gravity,
        *turned(qvel[0], qvel[1]),
        zero,
        zero,
        zero,
        qvel[2],
        *turned(field[0], field[1]),
        zero + point.field[2],
    ]
    rows = [[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1.0]]
    return PhysicsState(
        qpos=qpos,
        qvel=qvel,
        ctrl=ctrl,
        qacc_warmstart=jnp.zeros_like(qvel),
        sensordata=jnp.stack(sensordata),
        time=time,
        bodies=Bodies(
            robot=jnp.stack([x, y, zero + point.height]),
            rotation=jnp.stack([jnp.stack(row) for row in rows]),
            box=jnp.zeros(3, x.dtype),
            box_yaw=zero,
            pillar_contacts=jnp.zeros((), jnp.int32),
            vase_contacts=jnp.zeros((), jnp.int32),
        ),
    )
