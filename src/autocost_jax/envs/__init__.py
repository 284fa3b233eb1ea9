"""Safety Gym's worlds in MuJoCo MJX."""

import contextlib
import io

# MJX prints a line for each optional backend that is not installed.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
