"""What an episode looks like: the shapes of a world, and where they are in each frame.

MuJoCo in C moves the full scene (`models.scene_model`) to every recorded `qpos`, so
that a picture shows Safety Gym's geoms, whichever simplified model was stepped.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.layout import make_arena, sample_layout
from autocost_jax.envs.physics.models import load_spec, mujoco, scene_model
from autocost_jax.envs.sensors import lidar
from autocost_jax.evaluate import Recording
from autocost_jax.population import run_compiled
from autocost_jax.records import Key, Layout
from autocost_jax.viz.replay import Kind, Replay, Shape

MAX_FRAMES = 2000  # of a replay; a longer episode is shown every second step, or third
AHEAD = {"Point": 0.0, "Car": -np.pi / 2, "Doggo": 0.0}  # in the robot's frame
KINDS: dict[int, tuple[Kind, int]] = {  # how many of a geom's three sizes count
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2),
    int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
}
# Geoms whose look is not that of their kind of thing.
LOOKS = {
    "pointarrow": "trim",
    "left": "wheel",
    "right": "wheel",
    "rear": "wheel",
    "front_bumper": "trim",
    "front_connector": "trim",
    "back_bumper": "trim",
    "back_connector": "trim",
    **{f"ankle_{leg}": "trim" for leg in range(1, 5)},
}
# Safety Gym's colours, less glaring; alpha below 1 is a thing that cannot be touched.
COLOURS = {
    "floor": (0.93, 0.94, 0.95, 1.0),
    "tile": (0.86, 0.88, 0.90, 1.0),
    "goal": (0.18, 0.62, 0.38, 0.45),
    "hazards": (0.24, 0.44, 0.84, 0.45),
    "pillars": (0.54, 0.49, 0.86, 1.0),
    "vases": (0.16, 0.68, 0.74, 1.0),
    "box": (0.93, 0.72, 0.18, 1.0),
    "robot": (0.82, 0.24, 0.22, 1.0),
    "trim": (0.55, 0.13, 0.14, 1.0),
    "wheel": (0.22, 0.24, 0.28, 1.0),
    "violation": (0.86, 0.10, 0.10, 0.55),
}


class Scene(NamedTuple):
    """A world that can be looked at.

    Attributes:
      config: its configuration.
      model: the `mujoco.MjModel` of the whole scene.
      shapes: its solids; bodies are those of the model, less the world.
      robot: body of the robot.
      goal: body of the goal.
      reach: how far the robot reaches from its origin at rest, metres.
    """

    config: EnvConfig
    model: Any
    shapes: tuple[Shape, ...]
    robot: int
    goal: int
    reach: float


def random_layout(config: EnvConfig, key: Key) -> Layout:
    """A fresh layout of a world, without its physics; the key is consumed."""
    layout = run_compiled(_sample_layout, key, config=config)
    return jax.tree.map(np.asarray, layout)


def _sample_layout(key: Key, config: EnvConfig) -> Layout:
    return sample_layout(make_arena(config), key, np.float32)[0]


def at_rest(scene: Scene, layout: Layout) -> Recording:
    """A recording of a single moment: everything at rest in its place."""
    model, qpos = scene.model, np.array(scene.model.qpos0)

    def put(name: str, xy: Any, yaw: Any) -> None:
        body = model.body(name)
        start = int(model.jnt_qposadr[body.jntadr[0]])
        qpos[start : start + 2] = xy
        if body.jntnum[0] > 1:  # the Point: x, y, heading
            qpos[start + 2] = yaw
        else:
            qpos[start + 3 : start + 7] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)

    put("robot", layout.robot_xy, layout.robot_yaw)
    if scene.config.task == "Push":
        put("box", layout.box_xy, layout.box_yaw)
    if layout.vases is not None and layout.vases_yaw is not None:
        for i in range(scene.config.vases_num):
            put(f"vase{i}", layout.vases[i], layout.vases_yaw[i])
    return Recording(
        qpos=qpos[None],
        goal_xy=np.asarray(layout.goal_xy)[None],
        hazards=np.asarray(layout.hazards),
        pillars=np.asarray(layout.pillars),
        reward=np.zeros(0),
        cost=np.zeros(0),
        constraint_lidar=np.zeros((0, 8)),
    )


def make_scene(config: EnvConfig) -> Scene:
    """The scene of a world, and its geoms as shapes."""
    model = scene_model(config)
    robot_geoms = {geom.name for geom in load_spec(config.robot).geoms}
    names = [model.body(i).name for i in range(model.nbody)]
    shapes = []
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.name != "floor" and not geom.name.startswith("post"):
            look = _look(geom.name, robot_geoms)
            shapes.append(_shape(config, model, geom, look))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    robot = names.index("robot")
    reaches = [
        np.hypot(*(data.geom_xpos[i] - data.xpos[robot])[:2]) + model.geom_rbound[i]
        for i in range(model.ngeom)
        if model.geom(i).name in robot_geoms
    ]
    reach = float(max(reaches))
    return Scene(
        config, model, tuple(shapes), robot - 1, names.index("goal") - 1, reach
    )


def _look(name: str, robot_geoms: set[str]) -> str:
    if name in robot_geoms:
        return LOOKS.get(name, "robot")
    kind = name.rstrip("0123456789")
    return f"{kind}s" if kind in ("hazard", "pillar", "vase") else kind


def _shape(config: EnvConfig, model: Any, geom: Any, look: str) -> Shape:
    """A geom as a shape; the box and its four posts are one prism."""
    body = int(geom.bodyid[0])
    kind, sizes = KINDS[int(geom.type[0])]
    size, outline = geom.size[:sizes], ()
    if geom.name == "box":
        kind, size, outline = "prism", geom.size[2:], box_outline(config.box_size)
    return Shape(
        kind=kind,
        size=tuple(float(value) for value in size),
        pos=tuple(geom.pos.tolist()),
        quat=tuple(geom.quat.tolist()),
        body=body - 1,
        thing=int(model.body_rootid[body]) - 1,
        look=look,
        outline=outline,
    )


def box_outline(size: float) -> tuple[tuple[float, float], ...]:
    """Safety Gym's push box from above: a square with posts on its four corners.

    Args:
      size: half the edge of the square; the posts reach 1.5 times as far.
    """
    inner, outer = size / 2, 1.5 * size
    side = ((outer, -outer), (outer, -inner), (size, -inner), (size, inner))
    side += ((outer, inner),)
    corners = []
    for cos, sin in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        corners += [(cos * x - sin * y, sin * x + cos * y) for x, y in side]
    return tuple(corners)


def set_frame(scene: Scene, data: Any, recording: Recording, frame: int) -> None:
    """Move a `mujoco.MjData` of the scene to one frame of a recording."""
    for name, centres in (
        ("goal", recording.goal_xy[frame][None]),
        ("hazard", recording.hazards),
        ("pillar", recording.pillars),
    ):
        for i, xy in enumerate(centres):
            body = scene.model.body(name if name == "goal" else f"{name}{i}")
            data.mocap_pos[body.mocapid[0], :2] = xy
    data.qpos[:] = recording.qpos[frame]
    mujoco.mj_kinematics(scene.model, data)


def body_poses(
    scene: Scene, recording: Recording, frames: Sequence[int] | np.ndarray
) -> np.ndarray:
    """[F, M, 7] position and quaternion of every body; NaN once the world failed."""
    data = mujoco.MjData(scene.model)
    poses = np.full((len(frames), scene.model.nbody - 1, 7), np.nan)
    for row, frame in enumerate(frames):
        if np.isfinite(recording.qpos[frame]).all():
            set_frame(scene, data, recording, int(frame))
            poses[row] = np.concatenate([data.xpos, data.xquat], 1)[1:]
    return poses


def lidar_readings(
    scene: Scene, recording: Recording, poses: np.ndarray, frames: np.ndarray
) -> dict[str, np.ndarray]:
    """[F, n] the observed lidars by name, from the bodies' poses."""
    config = scene.config
    count = len(frames)
    targets = {"goal": recording.goal_xy[frames][:, None]}
    if config.task == "Push":
        targets["box"] = poses[:, None, scene.model.body("box").id - 1, :2]
    for kind, centres in (
        ("hazards", recording.hazards),
        ("pillars", recording.pillars),
    ):
        if getattr(config, f"observe_{kind}"):
            targets[kind] = np.broadcast_to(centres, (count, *centres.shape))
    if config.observe_vases:
        rows = [scene.model.body(f"vase{i}").id - 1 for i in range(config.vases_num)]
        targets["vases"] = poses[:, rows, :2]

    robot = np.asarray(poses[:, scene.robot], np.float32)
    position, rotation = robot[:, :3], _rotations(robot[:, 3:])
    settings = {
        "num_bins": config.lidar_num_bins,
        "max_dist": config.lidar_max_dist,
        "exp_gain": config.lidar_exp_gain,
        "alias": config.lidar_alias,
    }
    return {
        name: np.asarray(
            run_compiled(
                _lidars, np.asarray(objects, np.float32), position, rotation, **settings
            )
        )
        for name, objects in targets.items()
    }


def _lidars(objects: Any, position: Any, rotation: Any, **settings: Any) -> jax.Array:
    """[F, n] what is seen of objects [F, M, 2] from each pose."""
    return jax.vmap(lambda *pose: lidar(*pose, **settings))(objects, position, rotation)


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """[F, 3, 3] rotation matrices of unit quaternions [F, 4]."""
    out = np.empty((len(quaternions), 9))
    for row, quaternion in enumerate(quaternions):
        mujoco.mju_quat2Mat(out[row], quaternion)
    return out.reshape(-1, 3, 3).astype(np.float32)


def make_replay(
    config: EnvConfig,
    recording: Recording,
    *,
    intrinsic: np.ndarray | None = None,
    label: str = "",
) -> Replay:
    """A recording as the page draws it.

    Args:
      config: the world it was recorded in.
      recording: at least one step; beyond `MAX_FRAMES` only every k-th is drawn.
      intrinsic: [T] intrinsic cost of each step, if there is one.
      label: which policy this is.
    """
    scene = make_scene(config)
    steps = len(recording.reward)
    stride = max(1, -(-steps // MAX_FRAMES))
    frames = np.append(np.arange(0, steps, stride), steps)
    poses = body_poses(scene, recording, frames)
    moved = np.any(np.diff(recording.goal_xy, axis=0) != 0, axis=-1)

    def summed(values: np.ndarray) -> np.ndarray:
        """[F] sums over the steps that lead to each frame."""
        if not steps:
            return np.zeros(1)
        sums = np.add.reduceat(np.asarray(values, float), frames[:-1])
        return np.append(0.0, sums)

    return Replay(
        shapes=scene.shapes,
        poses=poses,
        robot=scene.robot,
        goal=scene.goal,
        heading=AHEAD[config.robot],
        reward=summed(recording.reward),
        cost=summed(recording.cost),
        violations=summed(recording.cost > 0),
        goals_met=np.cumsum(summed(moved)),
        lidars=lidar_readings(scene, recording, poses, frames),
        dt=config.frameskip_binom_n * float(scene.model.opt.timestep),
        steps=steps,
        stride=stride,
        extents=config.placements_extents,
        label=label,
        intrinsic=None if intrinsic is None else summed(intrinsic),
    )
