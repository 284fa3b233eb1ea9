"""What a run has left, read and checked: stages, cards, recorded episodes."""

import json
from pathlib import Path
from typing import Any

from autocost_jax.evaluate import Recording
from autocost_jax.files import ArraySpec, RunDirError, load_arrays
from autocost_jax.runs.config_files import list_stages

RECORDING = {
    "qpos": ArraySpec(("frames", None), "float32"),
    "goal_xy": ArraySpec(("frames", 2), "float32"),
    "hazards": ArraySpec((None, 2), "float32"),
    "pillars": ArraySpec((None, 2), "float32"),
    "reward": ArraySpec(("steps",), "float32"),
    "cost": ArraySpec(("steps",), "float32"),
    "constraint_lidar": ArraySpec(("steps", None), "float32"),
}


def stage_files(path: str | Path) -> list[Path]:
    """The files of a run's stages, from the first on.

    Raises:
      RunDirError: one of them is missing.
    """
    files = list_stages(path)
    for number, found in enumerate(files):
        if found != number:
            raise RunDirError(f"{path}: stage_{number:02d}.npz is missing")
    return list(files.values())


def read_object(file: Path) -> dict[str, Any]:
    """The object of a JSON file; an empty one if there is no such file.

    Raises:
      RunDirError: it holds no JSON object.
    """
    if not file.exists():
        return {}
    try:
        value = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise RunDirError(f"{file} is not readable: {error}") from None
    if not isinstance(value, dict):
        raise RunDirError(f"{file} must hold a JSON object, got {value!r:.40}")
    return value


def read_recording(file: Path) -> Recording:
    """The episode of a replay*.npz.

    Raises:
      RunDirError: the file is broken, or its arrays do not fit together.
    """
    arrays = load_arrays(file, RECORDING)
    frames, steps = len(arrays["qpos"]), len(arrays["reward"])
    if frames != steps + 1:
        raise RunDirError(f"{file} has {frames} poses for {steps} steps")
    return Recording(**arrays)
