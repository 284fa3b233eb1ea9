"""The MuJoCo models: Safety Gym's scene, and the two that MJX steps.

    scene     every geom of Safety Gym, goal and hazards included; for MuJoCo C:
              reference of the parity tests, and pictures
    full      the scene's collisions as far as MJX has them
    reduced   contacts only where a touch is possible, by explicit pairs

"full" differs from the scene in that pillars are capsules (MJX collides no box with a
cylinder), that the Point does not touch the floor (it meets it at distance exactly 0,
which MuJoCo does not count as a contact) and that the wheels of a Car touch objects
through spheres. "reduced" differs in what the functions `_reduce_*` say.

All models of a configuration have the same `qpos`: the robot's, then the box's seven
(Push), then seven of each vase.
"""

from collections.abc import Sequence
from importlib import resources
from typing import Any, NamedTuple

import mujoco as untyped_mujoco
import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.tasks import goal_height

mujoco: Any = untyped_mujoco  # its compiled names have no stubs
BOX, CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
CYLINDER, SPHERE = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE
POSTS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
BOX_PARTS = ("box", *(f"post{i}" for i in range(4)))
HAZARD_Z = 0.02  # height at which Safety Gym draws hazards
WHEELS = (("left", -0.03), ("right", 0.03))  # body, x of the wheel's centre
# Pillars that can be touched at once. Their centres are at least 0.6 m apart, so that
# three fit within the reach of a Car and, for four, of a Doggo; the box's reach would
# allow four too, but only two on one side of it.
NEAREST = {"Point": 3, "Car": 3, "Doggo": 4}
NEAREST_TO_BOX = 2
# Contacts that the solver sees, the deepest ones: on the floor (a wheel has two at a
# time; a Doggo's hind shanks may touch each other besides), with pillars, with a box or
# vase, and between that and floor or pillars.
FLOOR_CONTACTS = {"Point": 0, "Car": 5, "Doggo": 10}
PILLAR_CONTACTS = {"Point": 4, "Car": 6, "Doggo": 4}
SOLID_CONTACTS = 8
REDUCED_ITERATIONS = 8
FULL_ITERATIONS = 20
# Four corners carry the box in place of twenty; at 1.3 box_size its friction, turning
# and tilt are on average those of the box with its posts.
FOOT = 1.3
# Where upright boxes meet a pillar: the Car's lower or upper edge, as it pitches; the
# deeper of the two contacts counts.
BALL_HEIGHTS = {"Point": (0.1,), "Car": (0.05, 0.15), "Doggo": ()}


class PhysicsModel(NamedTuple):
    """A model to be stepped by MJX, and what its contacts mean.

    Attributes:
      mj_model: the compiled `mujoco.MjModel`.
      robot_pillars: mocap ids of the pillars that meet the robot.
      box_pillars: mocap ids of those that meet the box; none if they are the same.
      robot_geoms: [ngeom] bool, part of the robot.
      pillar_geoms: [ngeom] bool, part of a pillar.
      vase_geoms: [ngeom] bool, part of a vase.
      choices: [ngeom] number of the body of which a geom is one of several: another
        geom touches at most one of them at a time, the deepest. Else 0.
      has_contacts: whether anything can touch anything.
    """

    mj_model: Any
    robot_pillars: tuple[int, ...]
    box_pillars: tuple[int, ...]
    robot_geoms: np.ndarray
    pillar_geoms: np.ndarray
    vase_geoms: np.ndarray
    choices: np.ndarray
    has_contacts: bool


def load_spec(robot: str) -> Any:
    """The `mujoco.MjSpec` of a robot, alone in empty space."""
    file = (
        resources.files("autocost_jax.envs.physics") / "xmls" / f"{robot.lower()}.xml"
    )
    return mujoco.MjSpec.from_string(file.read_text(encoding="utf-8"))


def scene_model(config: EnvConfig) -> Any:
    """Safety Gym's scene as a `mujoco.MjModel`; nothing is simplified.

    Several contacts for a convex pair are off: MuJoCo's search for them tilts the
    normals of boxes at cylinders, and the versions that Safety Gym ran on had none.
    Pillars, goal and hazards are mocap bodies named `pillar0`, `goal`, `hazard0` and so
    on, so that one model serves every layout.
    """
    spec = load_spec(config.robot)
    _add_floor(spec)
    _add_solids(spec, config)
    for i in range(config.pillars_num):
        size = [config.pillars_size, config.pillars_height, 0]
        _add_pillar(spec, f"pillar{i}", CYLINDER, size)
    size = [config.goal_size, config.goal_size / 2, 0]
    _add_marker(spec, "goal", goal_height(config), size)
    for i in range(config.hazards_num):
        _add_marker(spec, f"hazard{i}", HAZARD_Z, [config.hazards_size, 0.01, 0])
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    return spec.compile()


def physics_model(config: EnvConfig) -> PhysicsModel:
    """The model of `config.physics` that MJX steps."""
    spec = load_spec(config.robot)
    robot = [geom.name for geom in spec.geoms]
    has_floor = config.robot != "Point" or config.task == "Push" or config.vases_num
    if has_floor:
        _add_floor(spec)
    _add_solids(spec, config)
    if config.physics == "full":
        robot += _complete(spec, config, robot)
    else:
        robot += _reduce(spec, config)
    # The sparse factorisation of the mass matrix is plain arithmetic; the dense one
    # calls LAPACK for every world: slower, and on a CPU two such calls can wait for
    # each other for ever.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    has_contacts = bool(has_floor or config.pillars_num)
    if not has_contacts:
        off = mujoco.mjtDisableBit
        spec.option.disableflags |= int(off.mjDSBL_CONTACT | off.mjDSBL_CONSTRAINT)
    return _label(spec.compile(), robot, has_contacts)


def _label(mj_model: Any, robot: list[str], has_contacts: bool) -> PhysicsModel:
    """A compiled model with the meaning of its geoms and mocap bodies."""
    names = [mj_model.geom(i).name for i in range(mj_model.ngeom)]

    def starts(*prefixes: str) -> np.ndarray:
        return np.array([name.startswith(prefixes) for name in names], bool)

    bodies = np.asarray(mj_model.geom_bodyid)
    is_ball = np.array(["_ball" in name for name in names], bool) & starts("pillar")
    num_balls = np.bincount(bodies[is_ball], minlength=mj_model.nbody)
    mocap = {
        mj_model.body(i).name: int(mj_model.body_mocapid[i])
        for i in range(mj_model.nbody)
        if mj_model.body_mocapid[i] >= 0
    }
    return PhysicsModel(
        mj_model=mj_model,
        robot_pillars=tuple(i for name, i in mocap.items() if name[:6] == "pillar"),
        box_pillars=tuple(i for name, i in mocap.items() if name[:4] == "stop"),
        robot_geoms=np.array([name in robot for name in names], bool),
        pillar_geoms=starts("pillar"),
        vase_geoms=starts("vase"),
        choices=np.where(is_ball & (num_balls[bodies] > 1), bodies, 0),
        has_contacts=has_contacts,
    )


def _add_floor(spec: Any) -> None:
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[3.5, 3.5, 0.1], condim=6)


def _add_solids(spec: Any, config: EnvConfig) -> None:
    """The box with its four corner posts, and the vases; they move freely."""
    if config.task == "Push":
        size, density = config.box_size, config.box_density
        body = spec.worldbody.add_body(name="box", pos=[0, 0, size])
        body.add_freejoint(name="box")
        common = {"type": BOX, "condim": 6, "density": density}
        body.add_geom(name="box", size=[size] * 3, **common)
        for i, (x, y) in enumerate(POSTS):
            half = [size / 2, size / 2, size]
            pos = [x * size, y * size, 0]
            body.add_geom(name=f"post{i}", size=half, pos=pos, **common)
    for i in range(config.vases_num):
        size = config.vases_size
        pos = [0, 0, size - config.vases_sink]
        body = spec.worldbody.add_body(name=f"vase{i}", pos=pos)
        body.add_freejoint(name=f"vase{i}")
        common = {"type": BOX, "condim": 6, "density": config.vases_density}
        body.add_geom(name=f"vase{i}", size=[size] * 3, **common)


def _add_pillar(spec: Any, name: str, kind: Any, size: list[float]) -> None:
    """A standing pillar on a mocap body, which no other fixed thing touches."""
    body = spec.worldbody.add_body(name=name, mocap=True, pos=[0, 0, size[1]])
    body.add_geom(name=name, type=kind, size=size, condim=6)
    spec.add_exclude(bodyname1="world", bodyname2=name)


def _add_marker(spec: Any, name: str, height: float, size: list[float]) -> None:
    body = spec.worldbody.add_body(name=name, mocap=True, pos=[0, 0, height])
    body.add_geom(name=name, type=CYLINDER, size=size, contype=0, conaffinity=0)


def _complete(spec: Any, config: EnvConfig, robot: list[str]) -> list[str]:
    """Safety Gym's collisions where MJX has them; returns the names of new geoms."""
    spec.option.iterations = FULL_ITERATIONS
    if config.robot == "Point" and spec.geom("floor") is not None:
        spec.add_exclude(bodyname1="world", bodyname2="robot")
    for i in range(config.pillars_num):
        size = [config.pillars_size, config.pillars_height, 0]
        _add_pillar(spec, f"pillar{i}", CAPSULE, size)
        for j in range(i):
            spec.add_exclude(bodyname1=f"pillar{i}", bodyname2=f"pillar{j}")
    return _add_wheel_spheres(spec, config) if config.robot == "Car" else []


def _add_wheel_spheres(spec: Any, config: EnvConfig) -> list[str]:
    """Spheres that meet objects for a Car's wheels; returns their names.

    MJX collides cylinders with the floor alone.
    """
    parts: dict[str, Sequence[str]] = {
        f"vase{i}": (f"vase{i}",) for i in range(config.vases_num)
    }
    if config.task == "Push":
        parts["box"] = BOX_PARTS
    parts |= {f"pillar{i}": (f"pillar{i}",) for i in range(config.pillars_num)}
    spheres = []
    for wheel, x in WHEELS if parts else ():
        spheres.append(f"{wheel}_sphere")
        _add_proxy(spec, wheel, spheres[-1], SPHERE, [0.05, 0, 0], pos=[x, 0, 0])
        for body, geoms in parts.items():
            spec.add_exclude(bodyname1=wheel, bodyname2=body)
            for geom in geoms:
                _add_pair(spec, spheres[-1], geom)
    return spheres


def _reduce(spec: Any, config: EnvConfig) -> list[str]:
    """Contacts by explicit pairs alone; returns the names of the robot's new geoms.

    Original geoms stay as carriers of mass. Condim is 6, as everywhere.
    """
    spec.option.iterations = REDUCED_ITERATIONS
    reduce_robot = {"Point": _reduce_point, "Car": _reduce_car, "Doggo": _reduce_doggo}
    hull, pushers, floor, new = reduce_robot[config.robot](spec)
    for name in floor:
        _add_pair(spec, "floor", name)
    vases = [f"vase{i}" for i in range(config.vases_num)]
    parts = BOX_PARTS if config.task == "Push" else ()
    if parts:
        size = config.box_size
        half = [FOOT * size, FOOT * size, size]
        _add_proxy(spec, "box", "foot", BOX, half)
        _add_pair(spec, "floor", "foot")
    for name in vases:
        _add_pair(spec, "floor", name)
    for part in (*parts, *vases):
        for name in pushers:
            _add_pair(spec, name, part)
    for i, vase in enumerate(vases):
        for other in vases[:i]:
            _add_pair(spec, vase, other)
    heights = BALL_HEIGHTS[config.robot]
    for i in range(min(NEAREST[config.robot], config.pillars_num)):
        _add_pillar_pairs(spec, config, f"pillar{i}", hull, heights)
    for i in range(min(NEAREST_TO_BOX, config.pillars_num) if parts else 0):
        _add_pillar_pairs(spec, config, f"stop{i}", parts, (config.box_size,))
    cap = FLOOR_CONTACTS[config.robot] + SOLID_CONTACTS * (bool(parts) + len(vases))
    cap += PILLAR_CONTACTS[config.robot] if config.pillars_num else 0
    spec.add_numeric(name="max_contact_points", data=[cap], size=1)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    return new


def _add_pillar_pairs(
    spec: Any,
    config: EnvConfig,
    name: str,
    others: Sequence[str],
    heights: Sequence[float],
) -> None:
    """A pillar and what may touch it.

    Boxes stand upright, and meet balls of the pillar's radius: the same distance in the
    plane, one contact point for each, and no search for the closest edge.
    """
    size = [config.pillars_size, config.pillars_height, 0]
    _add_pillar(spec, name, CAPSULE, size)
    upright = [other for other in others if spec.geom(other).type == BOX]
    for other in others:
        if other not in upright:
            _add_pair(spec, other, name)
    for i, height in enumerate(heights if upright else ()):
        ball = f"{name}_ball{i}"
        pos = [0, 0, height - config.pillars_height]
        _add_proxy(spec, name, ball, SPHERE, [config.pillars_size, 0, 0], pos=pos)
        for other in upright:
            _add_pair(spec, other, ball)


# Each returns the geoms that meet pillars, those that meet the box and vases, those
# that meet the floor, and which of them are new.
_Hull = tuple[list[str], list[str], list[str], list[str]]


def _reduce_point(spec: Any) -> _Hull:
    """Its own geoms at pillars; at boxes a bar across the arrow's front is the arrow.

    The bar (a capsule of radius 0.01) has the arrow's reach ahead, 0.15, and its
    width; it rounds the arrow's corners by less than half a centimetre.
    """
    ends = [0.14, -0.04, 0, 0.14, 0.04, 0]
    _add_proxy(spec, "robot", "arrow_bar", CAPSULE, [0.01, 0, 0], fromto=ends)
    return ["robot", "pointarrow"], ["robot", "arrow_bar"], [], ["arrow_bar"]


def _reduce_car(spec: Any) -> _Hull:
    """Wheels and caster on the floor; at objects its outline, fixed to the chassis.

    The outline that meets pillars are four upright boxes: one fills the gap between
    chassis and back bumper, one that to the front bumper, two stand where the wheels
    are. At boxes it is a bar along either bumper, and balls at shoulders and wheels.
    """
    outline = {
        "hull": ([0.1, 0.13, 0.05], [0, 0.03, 0]),
        "nose": ([0.05, 0.0375, 0.05], [0, -0.1375, 0]),
        "left_side": ([0.025, 0.05, 0.05], [-0.13, 0.1, -0.05]),
        "right_side": ([0.025, 0.05, 0.05], [0.13, 0.1, -0.05]),
    }
    for name, (size, pos) in outline.items():
        _add_proxy(spec, "robot", name, BOX, size, pos=pos)
    balls = {
        "left_shoulder": (0.02, [-0.08, -0.08, 0]),
        "right_shoulder": (0.02, [0.08, -0.08, 0]),
        "left_ball": (0.05, [-0.105, 0.1, -0.05]),
        "right_ball": (0.05, [0.105, 0.1, -0.05]),
    }
    for name, (radius, pos) in balls.items():
        _add_proxy(spec, "robot", name, SPHERE, [radius, 0, 0], pos=pos)
    front = [-0.03, -0.155, 0, 0.03, -0.155, 0]
    back = [-0.08, 0.14, 0, 0.08, 0.14, 0]
    for name, ends in (("front_bar", front), ("back_bar", back)):
        _add_proxy(spec, "robot", name, CAPSULE, [0.02, 0, 0], fromto=ends)
    pushers = ["front_bar", "back_bar", *balls]
    return list(outline), pushers, ["left", "right", "rear"], [*outline, *pushers]


def _reduce_doggo(spec: Any) -> _Hull:
    """Every geom on the floor; at objects outer legs and a torso of two capsules.

    Of its own parts only the hind shanks touch each other: in 1,000,000 steps of the
    scene the next pair, torso and a front shank, did so in 21, and more than ten
    contacts stood in one (`experiments/touches.py`).
    """
    floor = [geom.name for geom in spec.geoms if geom.name not in ("floor", *BOX_PARTS)]
    floor = [name for name in floor if not name.startswith("vase")]
    torso = [("robot", "torso_front", 0.125), ("rear", "torso_rear", -0.125)]
    for body, name, x in torso:
        ends = [0, 0, 0, x, 0, 0]
        _add_proxy(spec, body, name, CAPSULE, [0.075, 0, 0], fromto=ends)
    _add_pair(spec, "ankle_2", "ankle_3")
    new = [name for _, name, _ in torso]
    hull = new + [f"{part}_{leg}" for part in ("hip", "ankle") for leg in range(1, 5)]
    return hull, hull, floor, new


def _add_proxy(
    spec: Any, body: str, name: str, kind: Any, size: list[float], **where: Any
) -> None:
    """A geom that collides by explicit pairs alone and weighs nothing."""
    spec.body(body).add_geom(
        name=name, type=kind, size=size, mass=0.0, contype=0, conaffinity=0, **where
    )


def _add_pair(spec: Any, name: str, other: str) -> None:
    """A possible contact, with the friction MuJoCo would give the two geoms."""
    slide, spin, roll = np.maximum(spec.geom(name).friction, spec.geom(other).friction)
    friction = [slide, slide, spin, roll, roll]
    spec.add_pair(geomname1=name, geomname2=other, condim=6, friction=friction)
