"""A recorded episode as the page's script draws it: shapes, poses, numbers."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from autocost_jax.viz.cost_map import Array

Kind = Literal["sphere", "capsule", "cylinder", "box", "prism"]
POSE = 7  # position and unit quaternion (w, x, y, z)
UNKNOWN = -32768  # the code of a number that is not finite
TOP = 32767


@dataclass(frozen=True)
class Shape:
    """One solid of the scene, in the frame of the body that it is part of.

    Attributes:
      kind: sphere (radius), capsule or cylinder (radius, half-length; axis z), box
        (three half-sizes), prism (half-height; upright, over `outline`).
      size: metres.
      pos: centre.
      quat: orientation (w, x, y, z).
      body: row in `Replay.poses`.
      thing: number of the thing it belongs to; parts of one thing are drawn together.
      look: its colour, by name.
      outline: corners (x, y) of a prism, counter-clockwise.
    """

    kind: Kind
    size: tuple[float, ...]
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    body: int
    thing: int
    look: str
    outline: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Replay:
    """One recorded episode in F frames, world frame, metres.

    Frame 0 is the start. Numbers of a frame are sums over the steps that led to it
    from the frame before; zero in frame 0.

    Attributes:
      shapes: all solids; goal and hazards, which nothing can touch, are among them.
      poses: [F, M, 7] position and quaternion of each body.
      robot: body whose origin leaves the trail.
      goal: body that is the goal.
      heading: direction that is ahead in the robot's frame, radians from its x axis.
      reward: [F] reward.
      cost: [F] extrinsic cost.
      violations: [F] how many steps had any extrinsic cost.
      goals_met: [F] goals met so far.
      lidars: name of each lidar -> [F, n] readings in [0, 1], robot frame.
      dt: seconds a step.
      steps: how many steps the episode has.
      stride: steps from frame to frame; the last one may be shorter.
      extents: (xmin, ymin, xmax, ymax) of the placements.
      label: which policy this is: algorithm and cost, such as "CPO, best cost".
      intrinsic: [F] intrinsic cost, or None.

    Raises:
      ValueError: if shapes disagree.
    """

    shapes: tuple[Shape, ...]
    poses: Array
    robot: int
    goal: int
    heading: float
    reward: Array
    cost: Array
    violations: Array
    goals_met: Array
    lidars: Mapping[str, Array]
    dt: float
    steps: int
    stride: int
    extents: tuple[float, float, float, float]
    label: str = ""
    intrinsic: Array | None = None

    def __post_init__(self) -> None:
        frames, bodies = np.shape(self.poses)[:2]
        for name in ("reward", "cost", "violations", "goals_met", "intrinsic"):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (frames,):
                shape = np.shape(value)
                raise ValueError(f"replay.{name} must be [{frames}], got {shape}")
        if np.shape(self.poses) != (frames, bodies, POSE):
            shape = np.shape(self.poses)
            raise ValueError(f"replay.poses must be [F, M, 7], got shape {shape}")
        for name, value in self.lidars.items():
            if np.ndim(value) != 2 or len(value) != frames:
                shape = np.shape(value)
                raise ValueError(f"replay.lidars[{name!r}] must be [F, n], got {shape}")
        known = range(bodies)
        if not all(shape.body in known for shape in self.shapes):
            raise ValueError(f"replay.shapes must name bodies below {bodies}")


def replay_json(replay: Replay) -> dict[str, Any]:
    """The data of `replay.js`; arrays as base64 of little-endian numbers.

    Poses are quantised to 16 bits: positions to 1/32767 of the farthest one (0.1 mm in
    a 4 m arena), quaternions to 1/32767. Bodies that never move are sent once.
    """
    poses = np.array(replay.poses, float)
    poses[~np.isfinite(poses).all(-1)] = np.nan
    moves = [
        not np.array_equal(poses[:, i], np.repeat(poses[:1, i], len(poses), 0))
        for i in range(poses.shape[1])
    ]
    moving = np.flatnonzero(moves)
    sent = poses[:, moving]
    reach = np.abs(sent[..., :3])
    scale = float(np.nanmax(reach, initial=1e-3)) / TOP
    codes = np.concatenate([sent[..., :3] / scale, sent[..., 3:] * TOP], -1)
    return {
        "label": replay.label,
        "shapes": [_shape_json(shape) for shape in replay.shapes],
        "frames": len(poses),
        "bodies": poses.shape[1],
        "moving": moving.tolist(),
        "still": {
            str(i): _rounded(poses[0, i], 5) for i in np.flatnonzero(~np.array(moves))
        },
        "scale": scale,
        "poses": _packed(codes, "<i2"),
        "robot": replay.robot,
        "goal": replay.goal,
        "heading": round(replay.heading, 5),
        "reward": _packed(replay.reward, "<f4"),
        "cost": _packed(replay.cost, "<f4"),
        "violations": _packed(replay.violations, "<i2"),
        "goals_met": _packed(replay.goals_met, "<i2"),
        "intrinsic": None
        if replay.intrinsic is None
        else _packed(replay.intrinsic, "<f4"),
        "lidars": [
            {"name": name, "bins": int(np.shape(value)[1]), "values": _bytes(value)}
            for name, value in replay.lidars.items()
        ],
        "dt": replay.dt,
        "steps": replay.steps,
        "stride": replay.stride,
        "extents": [float(value) for value in replay.extents],
    }


def _shape_json(shape: Shape) -> dict[str, Any]:
    values = {
        "kind": shape.kind,
        "size": _rounded(shape.size, 5),
        "pos": _rounded(shape.pos, 5),
        "quat": _rounded(shape.quat, 5),
        "body": shape.body,
        "thing": shape.thing,
        "look": shape.look,
    }
    if shape.outline:
        values["outline"] = [_rounded(corner, 5) for corner in shape.outline]
    return values


def _rounded(values: Any, digits: int) -> list[float | None]:
    """A list; null where a number is not finite."""
    return [
        round(float(value), digits) if np.isfinite(value) else None for value in values
    ]


def _packed(values: Any, dtype: str) -> str:
    """Base64 of numbers; in whole ones, what is not finite is `UNKNOWN`."""
    array = np.asarray(values, float)
    if np.dtype(dtype).kind == "i":
        whole = np.clip(np.rint(array), -TOP, TOP)
        array = np.where(np.isfinite(array), whole, UNKNOWN)
    return base64.b64encode(array.astype(dtype).tobytes()).decode()


def _bytes(readings: Array) -> str:
    """Base64 of readings in [0, 1] as 0 ... 255; what is not finite is 0."""
    array = np.nan_to_num(np.asarray(readings, float), posinf=0.0, neginf=0.0)
    scaled = np.rint(255 * np.clip(array, 0, 1)).astype(np.uint8)
    return base64.b64encode(scaled.tobytes()).decode()
