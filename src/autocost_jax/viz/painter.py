"""The process that draws: MuJoCo's renderer, with a sun, a tiled floor and marks.

`picture.draw` starts it with an OpenGL that is known to work.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.models import mujoco
from autocost_jax.envs.tasks import goal_height
from autocost_jax.evaluate import Recording
from autocost_jax.runs.config_files import from_dict
from autocost_jax.viz.picture import FPS, Job, film_frames
from autocost_jax.viz.scene import (
    AHEAD,
    COLOURS,
    Scene,
    body_poses,
    lidar_readings,
    make_scene,
    set_frame,
)

LIGHT = np.array([-0.45, -0.35, 0.82])  # towards the light, as in view.js
TRAIL = 150  # frames


def main(listing: str) -> None:
    """Draw the jobs of a file that `draw` has written."""
    for row in json.loads(Path(listing).read_text()):
        with np.load(row["recording"], allow_pickle=False) as arrays:
            recording = Recording(**{name: arrays[name] for name in Recording._fields})
        job = Job(
            config=from_dict(EnvConfig, row["config"]),
            recording=recording,
            path=Path(row["path"]),
            size=tuple(row["size"]),
            camera=row["camera"],
            title=row["title"],
        )
        _save(job)


def _save(job: Job) -> None:
    scene = make_scene(job.config)
    steps = len(job.recording.reward)
    dt = job.config.frameskip_binom_n * float(scene.model.opt.timestep)
    suffix = job.path.suffix
    if suffix == ".png":
        from matplotlib.image import imsave

        (image,) = _images(job, scene, np.array([steps]))
        imsave(job.path, image)
        return
    frames, speed = film_frames(steps, dt, suffix)
    images = _captioned(job, _images(job, scene, frames), frames, dt, speed)
    if suffix == ".gif":
        _save_gif(job.path, images)
    else:
        _save_mp4(job.path, images, job.size)


def _save_gif(path: Path, images: Iterator[np.ndarray]) -> None:
    from PIL import Image

    first, *rest = (Image.fromarray(image) for image in images)
    palette = first.quantize(128, dither=Image.Dither.NONE)
    quantised = [
        frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in rest
    ]
    palette.save(
        path,
        save_all=True,
        append_images=quantised,
        duration=1000 / FPS[".gif"],
        loop=0,
        optimize=False,
    )


def _save_mp4(path: Path, images: Iterator[np.ndarray], size: tuple[int, int]) -> None:
    import imageio_ffmpeg

    writer = imageio_ffmpeg.write_frames(
        str(path), size, fps=int(FPS[".mp4"]), quality=7, macro_block_size=2
    )
    writer.send(None)
    for image in images:
        writer.send(np.ascontiguousarray(image))
    writer.close()


def _captioned(
    job: Job, images: Iterator[np.ndarray], frames: np.ndarray, dt: float, speed: int
) -> Iterator[np.ndarray]:
    """The images with time, return and cost so far; framed in red at a violation."""
    from PIL import Image, ImageDraw, ImageFont

    reward = np.append(0.0, np.cumsum(job.recording.reward))
    cost = np.append(0.0, np.cumsum(job.recording.cost))
    font = ImageFont.load_default(size=max(11, job.size[1] // 30))
    red = tuple(int(255 * value) for value in COLOURS["violation"][:3])
    pace = f", {speed} x" if speed > 1 else ""
    before = 0
    for frame, pixels in zip(frames, images, strict=True):
        image = Image.fromarray(pixels)
        pen = ImageDraw.Draw(image)
        text = (
            f"{job.title}   {frame * dt:.1f} s{pace}   return {reward[frame]:.2f}   "
            f"cost {cost[frame]:.2f}"
        )
        pen.text((10, 8), text, fill=(28, 36, 48), font=font)
        if cost[frame] > cost[before]:
            pen.rectangle(
                (0, 0, job.size[0] - 1, job.size[1] - 1), outline=red, width=6
            )
        before = frame
        yield np.asarray(image)


def _images(job: Job, scene: Scene, frames: np.ndarray) -> Iterator[np.ndarray]:
    """[height, width, 3] uint8 of each frame; a failed world is left out at its end."""
    width, height = job.size
    _paint(scene, job.size)
    scene.model.vis.map.shadowclip = 0.5 if job.camera == "track" else 1.0
    data = mujoco.MjData(scene.model)
    poses = body_poses(scene, job.recording, np.arange(len(job.recording.qpos)))
    readings = lidar_readings(scene, job.recording, poses[frames], frames)
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    with mujoco.Renderer(scene.model, height, width) as renderer:
        for row, frame in enumerate(frames):
            if np.isfinite(job.recording.qpos[frame]).all():
                set_frame(scene, data, job.recording, int(frame))
            camera = _camera(job, scene, poses, int(frame))
            renderer.update_scene(data, camera, option)
            _light(renderer.scene, camera.lookat)
            _veil_pillars(renderer.scene, job, poses[frame, scene.robot, :2])
            _decorate(renderer.scene, job, scene, poses, int(frame))
            if len(job.recording.reward):
                lit = {name: values[row] for name, values in readings.items()}
                _lidar_rings(renderer.scene, scene, poses[frame, scene.robot], lit)
            yield renderer.render().copy()


def _paint(scene: Scene, size: tuple[int, int]) -> None:
    """Colours, soft light and a large floor, in the model of this process."""
    model = scene.model
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.quality.shadowsize = 2048
    model.vis.headlight.ambient[:] = 0.45
    model.vis.headlight.diffuse[:] = 0.12
    model.vis.headlight.specular[:] = 0.0
    model.stat.extent = 8.0
    model.vis.map.zfar = 60.0
    model.geom("floor").size[:2] = 60.0
    model.geom("floor").rgba[:] = COLOURS["floor"]
    solid = [i for i in range(model.ngeom) if model.geom(i).name != "floor"]
    looks = iter(shape.look for shape in scene.shapes)
    for i in solid:
        is_post = model.geom(i).name.startswith("post")
        model.geom_rgba[i] = COLOURS["box" if is_post else next(looks)]
    for i in solid:  # what nothing can touch is drawn by `_decorate`, without a shadow
        if model.geom(i).name.startswith(("goal", "hazard")):
            model.geom_rgba[i, 3] = 0.0


def _camera(job: Job, scene: Scene, poses: np.ndarray, frame: int) -> Any:
    x0, y0, x1, y1 = job.config.placements_extents
    span = max(x1 - x0, y1 - y0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (x0 + x1) / 2, (y0 + y1) / 2, 0.0
    camera.azimuth, camera.elevation = 115.0, -42.0
    start = poses[0, scene.robot, :2] - camera.lookat[:2]
    if job.camera == "fixed" and np.isfinite(start).all():  # the robot starts in front
        camera.azimuth = np.degrees(np.arctan2(-start[1], -start[0])) + 20.0
    camera.distance = 1.38 * span
    if job.camera == "top":
        camera.azimuth, camera.elevation, camera.distance = 90.0, -90.0, 1.45 * span
    if job.camera == "track":
        near = poses[max(0, frame - 12) : frame + 13, scene.robot, :2]
        near = near[np.isfinite(near).all(-1)]
        if len(near):
            camera.lookat[:2] = near.mean(0)
        camera.distance, camera.elevation = 2.2 + 3.5 * scene.reach, -38.0
    return camera


def _light(drawn: Any, lookat: np.ndarray) -> None:
    """A sun with shadows around the point that is looked at."""
    light = drawn.lights[drawn.nlight]
    towards = LIGHT / np.linalg.norm(LIGHT)
    light.dir[:] = -towards
    light.pos[:] = lookat + 9.0 * towards
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.attenuation[:] = 1, 0, 0
    light.ambient[:], light.diffuse[:], light.specular[:] = 0.0, 0.55, 0.04
    light.castshadow, light.headlight = 1, 0
    drawn.nlight += 1


def _veil_pillars(drawn: Any, job: Job, robot: np.ndarray) -> None:
    """See-through pillars where they hide the robot."""
    eye = np.asarray(drawn.camera[0].pos)[:2]
    sight = robot - eye
    offset = job.recording.pillars - eye
    share = offset @ sight / max(float(sight @ sight), 1e-9)
    aside = np.abs(offset[:, 0] * sight[1] - offset[:, 1] * sight[0])
    aside /= max(float(np.linalg.norm(sight)), 1e-9)
    hides = (share > 0) & (share < 1) & (aside < job.config.pillars_size + 0.1)
    for geom in drawn.geoms[: drawn.ngeom]:
        near = np.linalg.norm(geom.pos[:2] - job.recording.pillars, axis=1) < 1e-3
        if (near & hides).any() and geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER:
            geom.rgba[3], geom.transparent = 0.35, 1


def _add(drawn: Any, kind: Any, size: Any, pos: Any, yaw: float, rgba: Any) -> Any:
    """A geom of this picture alone, turned about the vertical."""
    geom = drawn.geoms[drawn.ngeom]
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([cos, -sin, 0, sin, cos, 0, 0, 0, 1.0])
    size, pos, rgba = (np.array(x, np.float64) for x in (size, pos, rgba))
    mujoco.mjv_initGeom(geom, kind, size, pos, turn, rgba.astype(np.float32))
    geom.transparent = rgba[3] < 1
    geom.emission = 0.35 if rgba[3] < 1 else 0.0  # see-through things glow a little
    drawn.ngeom += 1
    return geom


def _decorate(
    drawn: Any, job: Job, scene: Scene, poses: np.ndarray, frame: int
) -> None:
    """Tiles, goal, hazards, the trail, and a red disc under a robot that violates."""
    box, disc = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    x0, y0, x1, y1 = (2 * x for x in job.config.placements_extents)
    for i in range(int(np.floor(x0)) - 2, int(np.ceil(x1)) + 2):
        for j in range(int(np.floor(y0)) - 2, int(np.ceil(y1)) + 2):
            if (i + j) % 2:
                centre = [(i + 0.5) / 2, (j + 0.5) / 2, 0.0004]
                _add(drawn, box, [0.25, 0.25, 0.0004], centre, 0, COLOURS["tile"])
    radius, config = job.config.hazards_size, job.config
    for x, y in job.recording.hazards:
        size = [radius, 0.001, 0]
        _add(drawn, disc, size, [x, y, 0.002], 0, _on_floor("hazards"))
    radius, (x, y) = config.goal_size, job.recording.goal_xy[frame]
    size = [radius, radius / 2, 0]
    _add(drawn, disc, size, [x, y, goal_height(config)], 0, COLOURS["goal"])
    capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
    cost, path = job.recording.cost, poses[: frame + 1, scene.robot, :2]
    shown = range(max(1, frame - TRAIL), frame + 1)
    for t in shown:
        (ax, ay), (bx, by) = path[t - 1], path[t]
        if not np.isfinite([ax, ay, bx, by]).all() or (ax, ay) == (bx, by):
            continue
        rgba = _on_floor("violation" if cost[t - 1] > 0 else "wheel", 0.6)
        geom = _add(drawn, capsule, [0.008] * 3, [0, 0, 0], 0, rgba)
        ends = np.array([ax, ay, 0.006]), np.array([bx, by, 0.006])
        mujoco.mjv_connector(geom, capsule, 0.006, *ends)
    if frame and cost[frame - 1] > 0:
        x, y = poses[frame, scene.robot, :2]
        size = [scene.reach + 0.06, 0.001, 0]
        _add(drawn, disc, size, [x, y, 0.003], 0, _on_floor("violation"))


def _on_floor(name: str, alpha: float | None = None) -> list[float]:
    """A see-through colour as it looks on the floor, opaque.

    MuJoCo lets see-through things throw shadows, which a mark on the floor must not.
    """
    *colour, own = COLOURS[name]
    share = own if alpha is None else alpha
    floor = COLOURS["tile"]
    mixed = [share * c + (1 - share) * f for c, f in zip(colour, floor, strict=False)]
    return [*mixed, 1.0]


def _lidar_rings(
    drawn: Any, scene: Scene, robot: np.ndarray, readings: dict[str, np.ndarray]
) -> None:
    """Each lidar as a ring of bins around the robot, and a mark where it is headed."""
    if not np.isfinite(robot).all():
        return
    box, parts = mujoco.mjtGeom.mjGEOM_BOX, 4
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, robot[3:])
    rotation = rotation.reshape(3, 3)

    def laid(angle: float) -> float:
        """A direction of the robot's frame as an angle on the floor."""
        x, y = (rotation @ [np.cos(angle), np.sin(angle), 0])[:2]
        return float(np.arctan2(y, x))

    def mark(yaw: float, radius: float, size: Any, rgba: Any) -> None:
        x, y = robot[:2] + radius * np.array([np.cos(yaw), np.sin(yaw)])
        _add(drawn, box, size, [x, y, 0.006], yaw, rgba)

    for k, (name, bins) in enumerate(readings.items()):
        radius = scene.reach + 0.12 + 0.1 * k
        step = 2 * np.pi / len(bins)
        size = [0.035, 0.85 * radius * np.tan(step / 2 / parts), 0.001]
        for i, reading in enumerate(bins):
            if reading <= 0:
                continue
            rgba = _on_floor(name, 0.1 + 0.85 * float(np.sqrt(reading)))
            for part in range(parts):
                angle = (i + 0.08 + 0.84 * (part + 0.5) / parts) * step
                mark(laid(angle), radius, size, rgba)
    tip = scene.reach + 0.12 + 0.1 * len(readings)
    heading = laid(AHEAD[scene.config.robot])
    mark(heading, tip, [0.05, 0.012, 0.001], COLOURS["wheel"])


if __name__ == "__main__":
    main(sys.argv[1])
