"""Recorded episodes of a run directory, as its report and its films show them."""

from pathlib import Path

from autocost_jax.evaluate import Recording
from autocost_jax.files import ArraySpec, RunDirError, load_arrays

SPEC = {
    "qpos": ArraySpec(("frames", None), "float32"),
    "goal_xy": ArraySpec(("frames", 2), "float32"),
    "hazards": ArraySpec((None, 2), "float32"),
    "pillars": ArraySpec((None, 2), "float32"),
    "reward": ArraySpec(("steps",), "float32"),
    "cost": ArraySpec(("steps",), "float32"),
    "constraint_lidar": ArraySpec(("steps", None), "float32"),
}


def read_recording(file: Path) -> Recording:
    """The episode of a replay*.npz.

    Raises:
      RunDirError: the file is broken, or its arrays do not fit together.
    """
    arrays = load_arrays(file, SPEC)
    frames, steps = len(arrays["qpos"]), len(arrays["reward"])
    if frames != steps + 1:
        raise RunDirError(f"{file} has {frames} poses for {steps} steps")
    return Recording(**arrays)
