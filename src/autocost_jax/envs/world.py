"""The physics: a robot in MuJoCo MJX, one control period at a time.

Names are resolved to integers once, when the world is made; what remains are pure
functions of `mjx.Data`.
"""

from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
from mujoco import mjx

from autocost_jax.config import EnvConfig
from autocost_jax.records import Layout

mujoco: Any = untyped_mujoco  # its compiled names have no stubs
SENSORS = ("accelerometer", "gyro", "magnetometer", "velocimeter")


class World(NamedTuple):
    """The physics of one robot, as pure functions of its data.

    Attributes:
      mj_model: the `mujoco.MjModel`; for rendering and for references in C.
      rest: data at the origin, at rest; a template.
      place: layout -> data at rest there, sensors evaluated.
      control_step: (data, action [U]) -> data one control period later.
      robot_xy: data -> [2] robot origin, from `qpos` alone.
      robot_pose: data -> position [3] and rotation [3, 3] of the robot's body.
      sensors: data -> name and reading of each sensor.
      sensor_sizes: name of each sensor -> how many numbers it reads.
      action_size: U.
      dt: seconds of a control period.
      dtype: floating type of the state.
    """

    mj_model: Any
    rest: mjx.Data
    place: Callable[[Layout], mjx.Data]
    control_step: Callable[[mjx.Data, jax.Array], mjx.Data]
    robot_xy: Callable[[mjx.Data], jax.Array]
    robot_pose: Callable[[mjx.Data], tuple[jax.Array, jax.Array]]
    sensors: Callable[[mjx.Data], dict[str, jax.Array]]
    sensor_sizes: Mapping[str, int]
    action_size: int
    dt: float
    dtype: Any


def load_spec(robot: str) -> Any:
    """The `mujoco.MjSpec` of a robot, alone in empty space."""
    file = resources.files("autocost_jax.envs") / "xmls" / f"{robot.lower()}.xml"
    return mujoco.MjSpec.from_string(file.read_text(encoding="utf-8"))


def make_world(config: EnvConfig) -> World:
    """The MJX world of a configuration.

    The Point touches nothing: the floor meets its sphere at distance exactly 0,
    which MuJoCo does not count as a contact, and hazards are not solid. Contacts and
    constraints are therefore switched off, which changes no number.
    """
    spec = load_spec(config.robot)
    spec.option.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    # The sparse factorisation is plain arithmetic; the dense one calls LAPACK for every
    # world, which took about 10 % more CPU time.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    mj_model = spec.compile()
    model = mjx.put_model(mj_model, impl="jax")
    rest = mjx.make_data(mj_model, impl="jax")
    model, rest = _fill_tendons(model, rest)
    body = mj_model.body("robot").id
    num_substeps = config.frameskip_binom_n
    sensor_slices = {
        name: slice(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))
        for name in SENSORS
        for sensor in (mj_model.sensor(name),)
    }

    def place(layout: Layout) -> mjx.Data:
        qpos = jnp.append(layout.robot_xy, layout.robot_yaw)
        return _refresh(model, rest.replace(qpos=qpos.astype(rest.qpos.dtype)))

    def control_step(data: mjx.Data, action: jax.Array) -> mjx.Data:
        low, high = model.actuator_ctrlrange.T
        ctrl = jnp.clip(action.astype(rest.ctrl.dtype), low, high)

        def substep(_, moving):
            return _substep(model, rest, ctrl, *moving)

        moving = (data.qpos, data.qvel)
        qpos, qvel = jax.lax.fori_loop(0, num_substeps, substep, moving)
        time = data.time + num_substeps * model.opt.timestep
        state = rest.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, time=time)
        return _refresh(model, state)

    def robot_xy(data: mjx.Data) -> jax.Array:
        return data.qpos[:2]

    def robot_pose(data: mjx.Data) -> tuple[jax.Array, jax.Array]:
        return data.xpos[body], data.xmat[body]

    def sensors(data: mjx.Data) -> dict[str, jax.Array]:
        return {name: data.sensordata[at] for name, at in sensor_slices.items()}

    return World(
        mj_model=mj_model,
        rest=rest,
        place=place,
        control_step=control_step,
        robot_xy=robot_xy,
        robot_pose=robot_pose,
        sensors=sensors,
        sensor_sizes={name: at.stop - at.start for name, at in sensor_slices.items()},
        action_size=int(mj_model.nu),
        dt=num_substeps * float(mj_model.opt.timestep),
        dtype=rest.qpos.dtype,
    )


def _fill_tendons(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Model, mjx.Data]:
    """One row of zeros in the tendon arrays of a model that has no tendon.

    MJX multiplies them also when they are empty, and partitioning an empty `where`
    over two devices crashes the CPU compiler of jaxlib 0.11. `model.ntendon` stays 0,
    so the row is never filled and adds exact zeros.
    """
    zeros = jnp.zeros((1, 2), data.qpos.dtype)
    model = model.replace(
        tendon_lengthspring=zeros,
        tendon_stiffness=zeros[:, 0],
        tendon_damping=zeros[:, 0],
    )
    data = data.replace(ten_length=zeros[:, 0])
    row: Any = {
        "_impl.ten_J": jnp.zeros((1, model.nv), data.qpos.dtype),
        "_impl.ten_velocity": zeros[:, 0],
    }
    filled: Any = data.tree_replace(row)
    return model, filled


def _substep(
    model: mjx.Model,
    rest: mjx.Data,
    ctrl: jax.Array,
    qpos: jax.Array,
    qvel: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """One physics step without constraints: MJX's own stages, less the idle ones.

    Left out are the forces applied from outside (there are none) and the sensors
    (read once, at the end of the control period).
    """
    data = rest.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    data = mjx.fwd_actuation(model, data)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    data = mjx.euler(model, data.replace(qfrc_smooth=force))
    return data.qpos, data.qvel


def _refresh(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Positions and sensors of the state that `data` holds now.

    `mjx.forward` skips the accelerometer where a model has no constraint at all, so
    that stage is called here.
    """
    return mjx.sensor_acc(model, mjx.forward(model, data))
