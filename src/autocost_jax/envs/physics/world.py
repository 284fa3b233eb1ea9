"""The physics: a scene in MuJoCo MJX, one control period at a time.

Names are resolved to integers once, when the world is made; what remains are pure
functions of `PhysicsState`.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.dynamics import (
    Forward,
    fill_tendons,
    make_forward,
    sense,
)
from autocost_jax.envs.physics.models import PhysicsModel, mujoco, physics_model
from autocost_jax.records import Bodies, Layout, PhysicsState

Moving = tuple[jax.Array, jax.Array, jax.Array]  # qpos, qvel, qacc_warmstart


class World(NamedTuple):
    """The physics of one scene, as pure functions of its state.

    Attributes:
      mj_model: the `mujoco.MjModel` that is stepped.
      place: layout -> state at rest there, sensors evaluated.
      control_step: (state, layout, action [U]) -> state one control period later; of
        the layout only the pillars are read.
      sensors: state -> name and reading of each sensor, as observed.
      sensor_sizes: name of each sensor -> how many numbers it is observed as.
      action_size: U.
      dt: seconds of a control period.
      dtype: floating type of the state.
    """

    mj_model: Any
    place: Callable[[Layout], PhysicsState]
    control_step: Callable[[PhysicsState, Layout, jax.Array], PhysicsState]
    sensors: Callable[[PhysicsState], dict[str, jax.Array]]
    sensor_sizes: Mapping[str, int]
    action_size: int
    dt: float
    dtype: Any


class _Scene(NamedTuple):
    """A model on the device, its dynamics, and where its parts are in the arrays."""

    physics: PhysicsModel
    model: mjx.Model
    rest: mjx.Data
    forward: Forward
    box: int | None
    vases: tuple[int, ...]


def make_world(config: EnvConfig) -> World:
    """The MJX world of a configuration."""
    physics = physics_model(config)
    mj_model = physics.mj_model
    model = mjx.put_model(mj_model, impl="jax")
    rest = mjx.make_data(mj_model, impl="jax")
    model, rest = fill_tendons(model, rest)
    scene = _Scene(
        physics=physics,
        model=model,
        rest=rest,
        forward=make_forward(physics, rest),
        box=mj_model.body("box").id if config.task == "Push" else None,
        vases=tuple(mj_model.body(f"vase{i}").id for i in range(config.vases_num)),
    )
    num_substeps = config.frameskip_binom_n
    substep = functools.partial(_contact_substep, scene.forward)
    if not physics.has_contacts:
        substep = _free_substep

    def place(layout: Layout) -> PhysicsState:
        qpos = _rest_qpos(scene, layout)
        moving = (qpos, jnp.zeros_like(rest.qvel), jnp.zeros_like(rest.qvel))
        start = rest.replace(mocap_pos=_mocap_positions(scene, layout, qpos))
        return _observe(scene, start, moving, jnp.zeros((), qpos.dtype))

    def control_step(
        state: PhysicsState, layout: Layout, action: jax.Array
    ) -> PhysicsState:
        low, high = model.actuator_ctrlrange.T
        ctrl = jnp.clip(action.astype(rest.ctrl.dtype), low, high)
        mocap_pos = _mocap_positions(scene, layout, state.qpos)
        start = rest.replace(ctrl=ctrl, mocap_pos=mocap_pos)
        moving = (state.qpos, state.qvel, state.qacc_warmstart)
        time = state.time + num_substeps * model.opt.timestep
        if physics.has_contacts and jax.default_backend() == "cpu":
            return _steps_in_one_loop(scene, start, moving, time, num_substeps)

        def body(_, moving: Moving) -> Moving:
            return substep(model, start, moving)

        moving = jax.lax.fori_loop(0, num_substeps, body, moving)
        return _observe(scene, start, moving, time)

    sensors, sizes = make_readings(mj_model)
    return World(
        mj_model=mj_model,
        place=place,
        control_step=control_step,
        sensors=sensors,
        sensor_sizes=sizes,
        action_size=int(mj_model.nu),
        dt=num_substeps * float(mj_model.opt.timestep),
        dtype=rest.qpos.dtype,
    )


def make_readings(
    mj_model: Any,
) -> tuple[Callable[[PhysicsState], dict[str, jax.Array]], dict[str, int]]:
    """The `sensors` and `sensor_sizes` of a World of this model."""
    readings = {
        mj_model.sensor(i).name: _reading(mj_model, i) for i in range(mj_model.nsensor)
    }

    def sensors(state: PhysicsState) -> dict[str, jax.Array]:
        return {name: read(state.sensordata) for name, read in readings.items()}

    zeros = np.zeros(mj_model.nsensordata)
    sizes = {name: jax.eval_shape(read, zeros).size for name, read in readings.items()}
    return sensors, sizes


def _reading(mj_model: Any, index: int) -> Callable[[jax.Array], jax.Array]:
    """How one sensor is observed, as a function of all raw readings.

    A ball joint's quaternion as its rotation matrix (row by row), an angle as sine and
    cosine, everything else as it is.

    Source: openai/safety-gym engine.py, build_observation_space and obs.
    """
    start = int(mj_model.sensor_adr[index])
    end = start + int(mj_model.sensor_dim[index])
    kind = mj_model.sensor_type[index]

    def read(sensordata: jax.Array) -> jax.Array:
        values = sensordata[start:end]
        if kind == mujoco.mjtSensor.mjSENS_BALLQUAT:
            return _rotation(values).ravel()
        if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
            return jnp.concatenate([jnp.sin(values), jnp.cos(values)])
        return jnp.asarray(values)

    return read


def _rotation(quaternion: jax.Array) -> jax.Array:
    """[3, 3] rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def _rest_qpos(scene: _Scene, layout: Layout) -> jax.Array:
    """Everything at rest in its place; heights as in the model."""
    mj_model = scene.physics.mj_model
    qpos = scene.rest.qpos

    def put(qpos: jax.Array, start: int, xy: jax.Array, yaw: jax.Array) -> jax.Array:
        qpos = qpos.at[start : start + 2].set(xy.astype(qpos.dtype))
        if mj_model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE and start == 0:
            return qpos.at[2].set(yaw.astype(qpos.dtype))  # the Point: x, y, heading
        turn = jnp.stack([jnp.cos(yaw / 2), 0 * yaw, 0 * yaw, jnp.sin(yaw / 2)])
        return qpos.at[start + 3 : start + 7].set(turn.astype(qpos.dtype))

    qpos = put(qpos, 0, layout.robot_xy, layout.robot_yaw)
    if scene.box is not None:
        qpos = put(qpos, _qpos_start(scene, scene.box), layout.box_xy, layout.box_yaw)
    for vase, xy, yaw in zip(scene.vases, *_vase_places(layout), strict=True):
        qpos = put(qpos, _qpos_start(scene, vase), xy, yaw)
    return qpos


def _vase_places(layout: Layout) -> tuple[Sequence[jax.Array], Sequence[jax.Array]]:
    """Position [2] and heading [] of each vase."""
    if layout.vases is None or layout.vases_yaw is None:
        return (), ()
    return list(layout.vases), list(layout.vases_yaw)


def _qpos_start(scene: _Scene, body: int) -> int:
    mj_model = scene.physics.mj_model
    return int(mj_model.jnt_qposadr[mj_model.body_jntadr[body]])


def _mocap_positions(scene: _Scene, layout: Layout, qpos: jax.Array) -> jax.Array:
    """[nmocap, 3] the pillars that can be touched: those nearest to robot and box."""
    mocap_pos = scene.rest.mocap_pos
    targets = [(scene.physics.robot_pillars, qpos[:2])]
    if scene.box is not None:
        start = _qpos_start(scene, scene.box)
        targets.append((scene.physics.box_pillars, qpos[start : start + 2]))
    for ids, xy in targets:
        if not ids:
            continue
        near = layout.pillars
        if len(ids) < len(near):
            distance = ((near - xy) ** 2).sum(-1)
            near = near[jax.lax.top_k(-distance, len(ids))[1]]
        mocap_pos = mocap_pos.at[np.array(ids), :2].set(near.astype(qpos.dtype))
    return mocap_pos


def _observe(
    scene: _Scene, start: mjx.Data, moving: Moving, time: jax.Array
) -> PhysicsState:
    """The state that `moving` is, its sensors and contacts evaluated."""
    return _state(scene, scene.forward(scene.model, _at(start, moving)), time)


def _at(start: mjx.Data, moving: Moving) -> mjx.Data:
    qpos, qvel, warmstart = moving
    return start.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)


def _state(scene: _Scene, data: mjx.Data, time: jax.Array) -> PhysicsState:
    """What is kept of data after `forward`, whose sensors are read here."""
    data = sense(scene.model, data)
    return PhysicsState(
        qpos=data.qpos,
        qvel=data.qvel,
        ctrl=data.ctrl,
        qacc_warmstart=data.qacc_warmstart,
        sensordata=data.sensordata,
        time=time,
        bodies=_bodies(scene, data),
    )


def _steps_in_one_loop(
    scene: _Scene, start: mjx.Data, moving: Moving, time: jax.Array, num_steps: int
) -> PhysicsState:
    """The state after some physics steps with contacts, as a CPU likes it.

    One more round of the loop evaluates the state at its end, so that the dynamics are
    compiled once, not twice. A GPU would have to be asked in each round whether it is
    the last.
    """
    shapes = jax.eval_shape(lambda: _observe(scene, start, moving, time))
    unseen = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def body(index: jax.Array, carry: tuple[Moving, PhysicsState]):
        moving, seen = carry
        data = scene.forward(scene.model, _at(start, moving))
        is_end = index == num_steps
        seen = jax.lax.cond(is_end, lambda: _state(scene, data, time), lambda: seen)
        after = mjx.euler(scene.model, data)
        return (after.qpos, after.qvel, after.qacc_warmstart), seen

    return jax.lax.fori_loop(0, num_steps + 1, body, (moving, unseen))[1]


def _bodies(scene: _Scene, data: mjx.Data) -> Bodies:
    """Where the movable bodies of `data` are and what touches what."""
    mj_model = scene.physics.mj_model
    dtype = data.qpos.dtype
    robot = mj_model.body("robot").id
    box = scene.box
    count = functools.partial(_count_contacts, scene, data)
    return Bodies(
        robot=data.xpos[robot],
        rotation=data.xmat[robot],
        box=jnp.zeros(3, dtype) if box is None else data.xpos[box],
        box_yaw=jnp.zeros((), dtype) if box is None else _yaw(data.xmat[box]),
        pillar_contacts=count(scene.physics.pillar_geoms),
        vase_contacts=count(scene.physics.vase_geoms),
        **_vases(scene, data),
    )


def _vases(scene: _Scene, data: mjx.Data) -> dict[str, jax.Array]:
    """Centres [V, 3], headings [V] and speeds [V] of the vases, if there are any."""
    if not scene.vases:
        return {}
    mj_model, ids = scene.physics.mj_model, np.array(scene.vases)
    starts = mj_model.jnt_dofadr[mj_model.body_jntadr[ids]]
    velocity = jnp.stack([data.qvel[start : start + 3] for start in starts])
    speed = jnp.sqrt((velocity**2).sum(-1))
    yaw = _yaw(data.xmat[ids])
    return {"vases": data.xpos[ids], "vases_yaw": yaw, "vases_speed": speed}


def _yaw(rotation: jax.Array) -> jax.Array:
    """Heading of a rotation [..., 3, 3], counter-clockwise from +x."""
    return jnp.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])


def _count_contacts(scene: _Scene, data: mjx.Data, geoms: np.ndarray) -> jax.Array:
    """[] how many contact points the robot has with certain geoms.

    As in MuJoCo, a contact is listed at a distance of at most 0. When leaning on a
    pillar the depth is only about 1e-4 m, so no positive depth may be asked for.
    """
    if not geoms.any():
        return jnp.zeros((), jnp.int32)
    impl: Any = data._impl
    contact = impl.contact
    robot = jnp.asarray(scene.physics.robot_geoms)[contact.geom]
    other = jnp.asarray(geoms)[contact.geom]
    is_pair = (robot[:, 0] & other[:, 1]) | (robot[:, 1] & other[:, 0])
    return (is_pair & (contact.dist <= 0)).sum(dtype=jnp.int32)


def _free_substep(model: mjx.Model, start: mjx.Data, moving: Moving) -> Moving:
    """One physics step without constraints: MJX's own stages, less the idle ones.

    Left out are the forces applied from outside (there are none) and the sensors
    (read once, at the end of the control period).
    """
    qpos, qvel, warmstart = moving
    data = start.replace(qpos=qpos, qvel=qvel)
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    data = mjx.fwd_actuation(model, data)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    data = mjx.euler(model, data.replace(qfrc_smooth=force))
    return data.qpos, data.qvel, warmstart


def _contact_substep(
    forward: Forward, model: mjx.Model, start: mjx.Data, moving: Moving
) -> Moving:
    """One physics step with contacts; what is not carried on is never computed."""
    data = mjx.euler(model, forward(model, _at(start, moving)))
    return data.qpos, data.qvel, data.qacc_warmstart
