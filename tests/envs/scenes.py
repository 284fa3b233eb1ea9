"""Safety Gym's scene in MuJoCo C, and the same runs in MJX, for the parity tests."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco as untyped_mujoco
import numpy as np
from env_data import blank_layout, stack

from autocost_jax.config import EnvConfig
from autocost_jax.envs.env import Env
from autocost_jax.envs.physics.models import BOX_PARTS, scene_model
from autocost_jax.records import EnvState, Layout

mujoco: Any = untyped_mujoco  # its compiled names have no stubs

Policy = Callable[[int, np.ndarray, np.ndarray], np.ndarray]  # step, qpos, rotation
FRONT = {"Point": (0, 1.0), "Car": (1, -1.0), "Doggo": (0, 1.0)}  # body axis, sign
ACTIONS = {"Point": 2, "Car": 2, "Doggo": 12}
REACH = {"Point": 0.16, "Car": 0.22, "Doggo": 0.37}
SPREAD = 0.6  # standard deviation of where ahead of the robot its target stands, rad


class Steps(NamedTuple):
    """Single control steps of the scene, one a row.

    Attributes:
      layouts: where the pillars stand.
      qpos, qvel, warmstart: the state before.
      actions: [N, U].
      next_qpos, next_qvel: the state after.
      touched: whether robot and target touch before; `touches` after.
    """

    layouts: Layout
    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray
    actions: np.ndarray
    next_qpos: np.ndarray
    next_qvel: np.ndarray
    touched: np.ndarray
    touches: np.ndarray


class Run(NamedTuple):
    """Many worlds side by side: [T, N, ...], the state after each step.

    Attributes:
      qpos, qvel: the physics.
      touches: whether the robot touches a pillar, or else the box; in MJX, pillars by
        its own count of contacts and the box by its own geoms, collided in C.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    touches: np.ndarray

    @property
    def onset(self) -> np.ndarray:
        """[N] the first step that ends in contact; T where there is none."""
        steps = self.touches.argmax(0) + 1
        return np.where(self.touches.any(0), steps, len(self.touches))


def control_step(model: Any, data: Any, action: Any, substeps: int = 10) -> None:
    data.ctrl[:] = np.clip(action, -1, 1)
    for _ in range(substeps):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)


def put(model: Any, data: Any, qpos: Any, qvel: Any, warmstart: Any = 0.0) -> None:
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, warmstart


def put_pillars(model: Any, data: Any, pillars: Any) -> None:
    for i, xy in enumerate(pillars):
        data.mocap_pos[model.body_mocapid[model.body(f"pillar{i}").id], :2] = xy


def touching(model: Any, data: Any, kind: str) -> set[int]:
    """Numbers of the pillars (or parts of the box) that the robot touches."""
    robot = model.body("robot").id
    found = set()
    for pair in data.contact.geom if data.ncon else ():
        is_robot = model.body_rootid[model.geom_bodyid[pair]] == robot
        name = model.geom(pair[np.argmin(is_robot)]).name
        if is_robot.sum() == 1 and kind == "pillar" and name.startswith("pillar"):
            found.add(int(name[6:]))
        if is_robot.sum() == 1 and kind == "box" and name in BOX_PARTS:
            found.add(BOX_PARTS.index(name))
    return found


def start_qpos(config: EnvConfig, model: Any, layout: Layout) -> np.ndarray:
    """[nq] everything at rest in its place."""
    qpos = np.array(model.qpos0)

    def turn(yaw: Any) -> list[Any]:
        return [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]

    qpos[:2] = layout.robot_xy
    if config.robot == "Point":
        qpos[2] = layout.robot_yaw
    else:
        qpos[3:7] = turn(layout.robot_yaw)
    if config.task == "Push":
        qpos[-7:-5], qpos[-4:] = layout.box_xy, turn(layout.box_yaw)
    return qpos


def worlds_at(
    env: Env, layouts: Layout, qpos: Any, qvel: Any, warmstart: Any = None
) -> EnvState:
    """States [N] of given physics; nothing is evaluated, only `step` compiles."""
    one: Layout = jax.tree.map(lambda x: np.asarray(x)[0], layouts)
    state: Any = jax.eval_shape(env.reset_to, one, jax.random.key(0))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state.replace(key=None))
    num, dtype = len(qpos), state.obs.dtype
    states = stack(zeros, num)
    physics = {"qpos": qpos, "qvel": qvel}
    if warmstart is not None:
        physics["qacc_warmstart"] = warmstart
    physics = {name: jnp.asarray(value, dtype) for name, value in physics.items()}
    return states.replace(
        data=states.data.replace(**physics),
        layout=jax.tree.map(lambda x: jnp.asarray(x, dtype), layouts),
        key=jax.random.split(jax.random.key(0), num),
    )


def stack_layouts(layouts: list[Layout]) -> Layout:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *layouts)


def free_layouts(config: EnvConfig, num: int) -> Layout:
    """[num] layouts of objects far away from the robot."""
    far = 50.0 + 2.0 * np.arange(config.pillars_num)[:, None] * np.ones(2)
    one = blank_layout(config, pillars=far, box_xy=np.full(2, -50.0))
    return stack_layouts([one] * num)


def target_layout(
    config: EnvConfig, rng: np.random.Generator, gap: tuple[float, float]
) -> Layout:
    """The robot at the origin and a pillar, or else the box, `gap` m ahead of it."""
    yaw = rng.uniform(0, 2 * np.pi)
    axis, sign = FRONT[config.robot]
    is_behind = config.robot != "Doggo" and rng.random() < 0.3
    angle = yaw + axis * sign * np.pi / 2 + is_behind * np.pi + SPREAD * rng.normal()
    ahead = np.array([np.cos(angle), np.sin(angle)])
    known = {"robot_yaw": np.asarray(yaw)}
    reach = REACH[config.robot] + rng.uniform(*gap)
    if config.pillars_num:
        first = ahead * (reach + config.pillars_size)
        known["pillars"] = pillars_around(config, rng, first)
    if config.task == "Push":
        radius = 1.5 * np.sqrt(2) * config.box_size
        near = ahead if not config.pillars_num else 20 * ahead
        known |= {"box_xy": near * (reach + radius)}
        known |= {"box_yaw": np.asarray(rng.uniform(0, 2 * np.pi))}
    return blank_layout(config, **known)


def pillars_around(
    config: EnvConfig, rng: np.random.Generator, first: np.ndarray
) -> np.ndarray:
    """[Q, 2] pillars: one given, the others free of it, of the robot, of each other."""
    pillars = [first]
    while len(pillars) < config.pillars_num:
        xy = rng.uniform(-1.7, 1.7, 2)
        clear = all(np.linalg.norm(xy - other) >= 0.6 for other in pillars)
        if clear and np.linalg.norm(xy) > 0.7:
            pillars.append(xy)
    return np.array(pillars)


def smooth_noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """The golden data's random actions: x = 0.9 x + 0.45 randn along the first axis."""
    out = np.zeros(shape)
    for step in range(shape[0]):
        previous = out[step - 1] if step else 0.0
        out[step] = 0.9 * previous + 0.45 * rng.standard_normal(shape[1:])
    return out


def steer(robot: str, xy: Any, rotation: Any, target: Any) -> np.ndarray:
    """[N, U] actions that drive towards targets [N, 2]; Doggo's are zero."""
    axis, sign = FRONT[robot]
    front = sign * rotation[:, :2, axis]
    offset = target - xy
    error = np.arctan2(offset[:, 1], offset[:, 0]) - np.arctan2(
        front[:, 1], front[:, 0]
    )
    error = (error + np.pi) % (2 * np.pi) - np.pi
    if robot == "Point":
        return np.stack([np.ones_like(error), np.clip(2 * error, -1, 1)], 1)
    turn = np.clip(1.5 * error, -1, 1)
    action = 0.02 * np.stack([1 + turn, 1 - turn], 1)
    return action if robot == "Car" else np.zeros((len(error), ACTIONS[robot]))


def chase(config: EnvConfig, layouts: Layout, rng: Any, num_steps: int) -> Policy:
    """Half of the worlds drive at their first pillar (or box), half at random."""
    num = len(layouts.robot_xy)
    noise = smooth_noise(rng, num_steps, num, ACTIONS[config.robot])
    is_chasing = (np.arange(num) % 2 == 0)[:, None] & (config.robot != "Doggo")
    scale = 0.01 if config.robot == "Car" else 0.25

    def act(step: int, qpos: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        target = layouts.pillars[:, 0] if config.pillars_num else qpos[:, -7:-5]
        chasing = steer(config.robot, qpos[:, :2], rotation, target)
        chasing += scale * noise[step]
        return np.clip(np.where(is_chasing, chasing, noise[step] + 0.3), -1, 1)

    return act


def touching_steps(config: EnvConfig, num: int, seed: int) -> Steps:
    """Control steps of random drives that begin or end in contact with the target."""
    rng = np.random.default_rng(seed)
    model = scene_model(config)
    data = mujoco.MjData(model)
    kind = "pillar" if config.pillars_num else "box"
    rows = []
    while len(rows) < 3 * num:
        layout = target_layout(config, rng, (0.02, 0.2))
        mujoco.mj_resetData(model, data)
        put(model, data, start_qpos(config, model, layout), 0.0)
        put_pillars(model, data, layout.pillars)
        mujoco.mj_forward(model, data)
        batch = stack_layouts([layout] * 2)
        act = chase(config, batch, rng, 60)
        row = int(rng.random() < 0.5)
        for step in range(60):
            rotation = np.array([data.body("robot").xmat.reshape(3, 3)] * 2)
            action = act(step, np.array([data.qpos] * 2), rotation)[row]
            state = [data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()]
            touched = bool(touching(model, data, kind))
            control_step(model, data, action)
            touches = bool(touching(model, data, kind))
            if touched or touches:
                after = [data.qpos.copy(), data.qvel.copy(), touched, touches]
                rows.append((layout, *state, action, *after))
    chosen = [rows[i] for i in rng.permutation(len(rows))[:num]]
    layouts, *columns = zip(*chosen, strict=True)
    return Steps(
        stack_layouts(list(layouts)), *(np.array(column) for column in columns)
    )


def run_scene(
    config: EnvConfig, layouts: Layout, policy: Policy, num_steps: int
) -> Run:
    """Many worlds of the scene in MuJoCo C."""
    model = scene_model(config)
    worlds = []
    for row in range(len(layouts.robot_xy)):
        layout = jax.tree.map(lambda x, row=row: np.asarray(x)[row], layouts)
        data = mujoco.MjData(model)
        put(model, data, start_qpos(config, model, layout), 0.0)
        put_pillars(model, data, layout.pillars)
        mujoco.mj_forward(model, data)
        worlds.append(data)
    kind = "pillar" if config.pillars_num else "box"
    rows = []
    for step in range(num_steps):
        qpos = np.array([data.qpos for data in worlds])
        rotation = np.array([data.body("robot").xmat.reshape(3, 3) for data in worlds])
        for data, action in zip(worlds, policy(step, qpos, rotation), strict=True):
            control_step(model, data, action)
        touches = [bool(touching(model, data, kind)) for data in worlds]
        qpos, qvel = zip(*((d.qpos.copy(), d.qvel.copy()) for d in worlds), strict=True)
        rows.append((qpos, qvel, touches))
    return Run(*(np.array(column) for column in zip(*rows, strict=True)))


def run_env(
    env: Env, step_all: Any, layouts: Layout, policy: Policy, num_steps: int
) -> Run:
    """The same in MJX; `step_all` is the compiled step of all worlds."""
    model = scene_model(env.config)
    num = len(layouts.robot_xy)
    rows = [jax.tree.map(lambda x, i=i: np.asarray(x)[i], layouts) for i in range(num)]
    qpos = np.array([start_qpos(env.config, model, layout) for layout in rows])
    state = worlds_at(env, layouts, qpos, np.zeros((num, model.nv)))
    yaw = np.asarray(layouts.robot_yaw)
    rotation = np.zeros((num, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(yaw)
    rotation[:, 1, 0], rotation[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    data = mujoco.MjData(env.mj_model)

    def touches_box(qpos: np.ndarray) -> bool:
        put(env.mj_model, data, qpos, 0.0)
        mujoco.mj_fwdPosition(env.mj_model, data)
        return bool(touching(env.mj_model, data, "box"))

    found = []
    for step in range(num_steps):
        state = step_all(state, policy(step, np.asarray(state.data.qpos), rotation))
        rotation = np.asarray(state.data.bodies.rotation)
        qpos, qvel = np.asarray(state.data.qpos), np.asarray(state.data.qvel)
        touches = np.asarray(state.data.bodies.pillar_contacts) > 0
        if not env.config.pillars_num and env.config.task == "Push":
            touches = [touches_box(row) for row in qpos]
        found.append((qpos, qvel, touches))
    return Run(*(np.array(column) for column in zip(*found, strict=True)))
