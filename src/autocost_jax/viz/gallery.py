"""A contact sheet of worlds: a picture and the facts of each."""

import base64
import mimetypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from autocost_jax.config import EnvConfig, env_config
from autocost_jax.envs.env import Env, make_env
from autocost_jax.evaluate import Recording
from autocost_jax.files import write_atomic
from autocost_jax.records import root_key
from autocost_jax.viz.markup import asset, escape, fill
from autocost_jax.viz.picture import Job, draw, why_not
from autocost_jax.viz.replay import Shape
from autocost_jax.viz.scene import (
    COLOURS,
    Scene,
    at_rest,
    body_poses,
    make_scene,
    random_layout,
)

SIZE = (640, 480)


class Gallery(NamedTuple):
    """What `write_gallery` has written.

    Attributes:
      index: the contact sheet.
      pictures: one file a world.
      hint: why the pictures are only seen from above, or None.
    """

    index: Path
    pictures: list[Path]
    hint: str | None


def write_gallery(names: Sequence[str], out: Path, seed: int = 0) -> Gallery:
    """A picture of each world in a folder, and index.html, which shows them all.

    PNGs by MuJoCo's renderer where an OpenGL is found, else drawings from above (SVG).

    Args:
      names: worlds that `env_config` knows.
      out: folder.
      seed: of the layouts.

    Raises:
      ValueError: an unknown world; nothing is written.
    """
    configs = [env_config(name) for name in names]
    hint = why_not(".png")
    suffix = ".png" if hint is None else ".svg"
    jobs = []
    for name, config in zip(names, configs, strict=True):
        scene = make_scene(config)
        moment = at_rest(scene, random_layout(config, root_key(seed)))
        job = Job(config, moment, out / f"{name}{suffix}", SIZE, camera="fixed")
        if hint is not None:
            write_atomic(job.path, top_view(scene, moment).encode())
        jobs.append(job)
    if hint is None:
        draw(jobs)
    paths = [job.path for job in jobs]
    cards = "\n".join(map(_card, names, configs, paths))
    parts = {"style": asset("page.css"), "count": str(len(names)), "cards": cards}
    write_atomic(out / "index.html", fill(asset("gallery.html"), parts).encode())
    return Gallery(out / "index.html", paths, hint)


def env_facts(config: EnvConfig, env: Env) -> dict[str, str]:
    """What there is to know about a world, name by name, as plain text."""
    sizes = {name: part.stop - part.start for name, part in env.obs_slices.items()}
    lidars = [name for name in sizes if name.endswith("_lidar")]
    rest = sum(sizes.values()) - sum(sizes[name] for name in lidars)
    law = (
        "exponential"
        if config.lidar_max_dist is None
        else f"linear to {config.lidar_max_dist:g} m"
    )
    x0, y0, x1, y1 = config.placements_extents
    seconds = env.episode_length * env.dt
    seen = ", ".join(name.removesuffix("_lidar") for name in lidars)
    bins = f"{config.lidar_num_bins} bins ({law})"
    return {
        "Observation": f"{env.observation_size}: {rest} of the robot's sensors, lidars "
        f"of {bins} for {seen}",
        "Action": f"{env.action_size} in [−1, 1]",
        "Episode": f"{env.episode_length} steps of {env.dt:g} s, {seconds:g} s in all",
        "Objects": _objects(config),
        "Arena": f"{x1 - x0:g} m x {y1 - y0:g} m",
        "Cost of a step": cost_rule(config),
    }


def cost_rule(config: EnvConfig) -> str:
    """The extrinsic cost of a step, in words."""
    rules = {
        "hazards": "the robot's depth in hazards, max(0, R − d) each",
        "pillars": "1 while the robot touches a pillar",
        "vases": "contacts with vases and the speed of those that move",
    }
    text = " + ".join(rules[kind] for kind in config.constrained)
    if not config.constrain_indicator:
        return text
    things = {
        "hazards": "is in a hazard",
        "pillars": "touches a pillar",
        "vases": "touches or moves a vase",
    }
    return f"1 while it {' or '.join(things[kind] for kind in config.constrained)}"


def _objects(config: EnvConfig) -> str:
    parts = [f"goal (radius {config.goal_size:g} m)"]
    if config.task == "Push":
        parts.append(f"box (half-edge {config.box_size:g} m)")
    for kind, measure in (
        ("hazards", "radius"),
        ("pillars", "radius"),
        ("vases", "half-edge"),
    ):
        number = getattr(config, f"{kind}_num")
        if number:
            name = kind if number > 1 else kind[:-1]
            parts.append(
                f"{number} {name} ({measure} {getattr(config, f'{kind}_size'):g} m)"
            )
    return ", ".join(parts)


def _card(name: str, config: EnvConfig, picture: Path) -> str:
    facts = env_facts(config, make_env(config))
    rows = "".join(
        f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items()
    )
    kind = mimetypes.guess_type(picture.name)[0]
    source = base64.b64encode(picture.read_bytes()).decode()
    words = f"The world {name} at the start of an episode."
    return (
        f'<figure id="{escape(name)}"><img alt="{escape(words)}" '
        f'src="data:{kind};base64,{source}"><figcaption><h3>{escape(name)}</h3>'
        f'<dl class="facts">{rows}</dl></figcaption></figure>'
    )


# ---- drawings from above, for machines without OpenGL


def top_view(scene: Scene, recording: Recording) -> str:
    """The last frame of a recording from above, as an SVG document."""
    frame = len(recording.qpos) - 1
    poses = body_poses(scene, recording, [frame])[0]
    x0, y0, x1, y1 = (
        edge + side * 0.25
        for edge, side in zip(
            scene.config.placements_extents, (-1, -1, 1, 1), strict=True
        )
    )
    parts = [_rect(x0, y0, x1, y1, "floor"), *_tiles(x0, y0, x1, y1)]
    parts.append(_rect(*scene.config.placements_extents, None))
    heights = [poses[shape.body][2] + shape.pos[2] for shape in scene.shapes]
    for i in np.argsort(heights, kind="stable"):
        parts.append(_shape_svg(scene.shapes[i], poses[scene.shapes[i].body]))
    # SVG's y points down, the arena's up.
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{x0:g} {-y1:g} {x1 - x0:g} '
        f'{y1 - y0:g}" width="{SIZE[0]}" height="{SIZE[1]}">'
        f'<g transform="scale(1 -1)">{"".join(parts)}</g></svg>\n'
    )


def _colour(name: str) -> str:
    red, green, blue, alpha = COLOURS[name]
    text = ",".join(str(round(255 * value)) for value in (red, green, blue))
    return f'fill="rgb({text})" fill-opacity="{alpha:g}"'


def _rect(x0: float, y0: float, x1: float, y1: float, look: str | None) -> str:
    outline = 'fill="none" stroke="#77808c" stroke-width="0.015"'
    place = f'x="{x0:g}" y="{y0:g}" width="{x1 - x0:g}" height="{y1 - y0:g}"'
    return f"<rect {place} {_colour(look) if look else outline}/>"


def _tiles(x0: float, y0: float, x1: float, y1: float) -> list[str]:
    size = 0.5
    columns = range(int(np.floor(x0 / size)), int(np.ceil(x1 / size)))
    rows = range(int(np.floor(y0 / size)), int(np.ceil(y1 / size)))
    return [
        _rect(i * size, j * size, (i + 1) * size, (j + 1) * size, "tile")
        for i in columns
        for j in rows
        if (i + j) % 2
    ]


def _shape_svg(shape: Shape, pose: np.ndarray) -> str:
    """One solid, seen from above."""
    turn = _matrix(pose[3:]) @ _matrix(shape.quat)
    centre = pose[:3] + _matrix(pose[3:]) @ np.array(shape.pos)
    style = _colour(shape.look)
    draws: dict[str, Callable[..., str]] = {
        "sphere": _svg_round,
        "capsule": _svg_capsule,
        "cylinder": _svg_cylinder,
        "box": _svg_box,
        "prism": _svg_prism,
    }
    return draws[shape.kind](shape, centre, turn, style)


def _matrix(quaternion: Any) -> np.ndarray:
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _svg_round(shape: Shape, centre: Any, turn: Any, style: str) -> str:
    x, y = centre[:2]
    return f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{shape.size[0]:g}" {style}/>'


def _svg_capsule(shape: Shape, centre: Any, turn: Any, style: str) -> str:
    (ax, ay), (bx, by) = (
        (centre + sign * shape.size[1] * turn[:, 2])[:2] for sign in (-1, 1)
    )
    return (
        f'<line x1="{ax:.4f}" y1="{ay:.4f}" x2="{bx:.4f}" y2="{by:.4f}" '
        f'stroke-width="{2 * shape.size[0]:g}" stroke-linecap="round" '
        f"{style.replace('fill', 'stroke')}/>"
    )


def _svg_cylinder(shape: Shape, centre: Any, turn: Any, style: str) -> str:
    axis = turn[:2, 2]
    if np.linalg.norm(axis) < 0.3:
        return _svg_round(shape, centre, turn, style)
    radius, half = shape.size
    along = axis * half
    across = radius * np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    corners = [centre[:2] + i * along + j * across for i, j in _CORNERS]
    return _polygon(corners, style)


def _svg_box(shape: Shape, centre: Any, turn: Any, style: str) -> str:
    sides = turn[:2] * np.array(shape.size)
    flat = np.argsort(np.linalg.norm(sides, axis=0))[1:]  # the two widest from above
    u, v = sides[:, flat[0]], sides[:, flat[1]]
    return _polygon([centre[:2] + i * u + j * v for i, j in _CORNERS], style)


def _svg_prism(shape: Shape, centre: Any, turn: Any, style: str) -> str:
    corners = [centre[:2] + turn[:2, :2] @ np.array(corner) for corner in shape.outline]
    return _polygon(corners, style)


def _polygon(corners: Sequence[Any], style: str) -> str:
    points = " ".join(f"{x:.4f},{y:.4f}" for x, y in corners)
    return f'<polygon points="{points}" {style}/>'


_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
