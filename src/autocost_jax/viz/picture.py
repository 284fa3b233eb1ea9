"""Pictures and films by MuJoCo's renderer, drawn in a process of their own.

MuJoCo settles on an OpenGL when it is imported, and a broken driver may take the whole
process down. So the library that is there is found by letting other processes try, and
`python -m autocost_jax.viz.painter JOBS.json` draws with it.
"""

import functools
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from autocost_jax.config import EnvConfig
from autocost_jax.evaluate import Recording
from autocost_jax.runs.config_files import to_dict

Camera = Literal["track", "fixed", "top"]
FILMS = (".mp4", ".gif")
SPEEDS = (1, 2, 4, 8, 16, 32)
FPS = {".mp4": 25.0, ".gif": 12.5}
MOST_FRAMES = {".mp4": 750, ".gif": 300}  # half a minute
PROBE = """
import os, mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 32, 32)
renderer.update_scene(data)
os._exit(0 if renderer.render().max() > 0 else 1)
"""


class Job(NamedTuple):
    """One picture or film.

    Attributes:
      config: the world.
      recording: what happened in it.
      path: where to; the suffix is .png (of the last frame), .mp4 or .gif.
      size: width and height in pixels.
      camera: "track" follows the robot, "fixed" and "top" see the whole arena.
      title: written into the frames of a film, with time, return and cost.
    """

    config: EnvConfig
    recording: Recording
    path: Path
    size: tuple[int, int] = (640, 480)
    camera: Camera = "track"
    title: str = ""


def film_size(path: Path, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """Width and height of a film; those of a GIF, which grows fast, are smaller.

    Raises:
      ValueError: not the name of a film, or not a size that a film can have.
    """
    if path.suffix not in FILMS:
        raise ValueError(f"video must end in {' or '.join(FILMS)}, got {str(path)!r}")
    size = size or ((480, 360) if path.suffix == ".gif" else (640, 480))
    if any(value % 2 or not 64 <= value <= 3840 for value in size):
        raise ValueError(f"size must be two even numbers in [64, 3840], got {size}")
    return size


@functools.cache
def find_backend() -> str | None:
    """The value of MUJOCO_GL that draws here, or None; a user's own is the only try."""
    chosen = os.environ.get("MUJOCO_GL")
    backends = ("egl", "osmesa") if sys.platform.startswith("linux") else ("",)
    for backend in backends if chosen is None else (chosen,):
        try:
            done = subprocess.run(
                [sys.executable, "-c", PROBE],
                env=_environment(backend), capture_output=True, timeout=60,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return backend
    return None


def why_not(suffix: str) -> str | None:
    """What a .png, .mp4 or .gif lacks here, in one line; None if nothing."""
    packages = {".mp4": ("imageio_ffmpeg", "PIL"), ".gif": ("PIL",)}.get(suffix, ())
    if any(importlib.util.find_spec(name) is None for name in packages):
        return f"a {suffix} needs pip install 'autocost-jax[render]'"
    if find_backend() is None:
        tried = os.environ.get("MUJOCO_GL") or "egl, osmesa"
        return (
            f"no OpenGL that works (tried {tried}); on Debian: "
            "apt-get install libegl1 libgl1-mesa-dri, or libosmesa6"
        )
    return None


def draw(jobs: Sequence[Job]) -> None:
    """Draw all jobs in one other process; `why_not` should have returned None.

    Raises:
      RuntimeError: the process failed; the message is its last line.
    """
    backend = find_backend()
    if backend is None:
        raise RuntimeError("no OpenGL that works")
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for i, job in enumerate(jobs):
            file = Path(folder) / f"{i}.npz"
            np.savez(file, allow_pickle=False, **job.recording._asdict())
            job.path.parent.mkdir(parents=True, exist_ok=True)
            row = {"config": to_dict(job.config), "recording": str(file)}
            row |= {"path": str(job.path.absolute()), "size": job.size}
            rows.append(row | {"camera": job.camera, "title": job.title})
        listing = Path(folder) / "jobs.json"
        listing.write_text(json.dumps(rows))
        done = subprocess.run(
            [sys.executable, "-m", "autocost_jax.viz.painter", str(listing)],
            env=_environment(backend), capture_output=True, text=True,
        )  # fmt: skip
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise RuntimeError(f"drawing failed: {lines[-1] if lines else done.returncode}")


def _environment(backend: str) -> dict[str, str]:
    """JAX is only asked for lidars there, and must not take a GPU's memory."""
    return {**os.environ, "MUJOCO_GL": backend, "JAX_PLATFORMS": "cpu"}


def film_frames(steps: int, dt: float, suffix: str) -> tuple[np.ndarray, int]:
    """Which frames a film shows, and how many times as fast as life it runs."""
    fps, most = FPS[suffix], MOST_FRAMES[suffix]
    for speed in SPEEDS:
        times = np.arange(0, steps * dt + 1e-9, speed / fps)
        if len(times) <= most:
            break
    frames = np.minimum(np.rint(times / dt).astype(int), steps)
    return frames, speed
