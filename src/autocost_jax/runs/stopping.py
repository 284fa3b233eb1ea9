"""Being asked to stop: by Ctrl-C, by a scheduler, by a closed terminal.

While epochs are computed a signal is only noted, so that the epochs at hand end whole
and a checkpoint can be written. A second one ends the program at once.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

# SIGHUP is not known on Windows.
SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP")
    if hasattr(signal, name)
)


class Stopped(KeyboardInterrupt):
    """A run has been asked to stop, and did so after a checkpoint.

    Attributes:
      signum: which signal asked.
      path: the run directory.
    """

    def __init__(self, signum: int, path: Path) -> None:
        super().__init__(f"{signal.Signals(signum).name}: stopped after a checkpoint")
        self.signum, self.path = signum, path


@contextlib.contextmanager
def noted_signals() -> Iterator[Callable[[], int | None]]:
    """Signals within are noted, not acted on, unless the same comes again.

    Only the main thread can do so; in any other they do what they did before.

    Yields:
      () -> number of the first signal that has come, None before.
    """
    came: list[int] = []

    def note(signum: int, frame: FrameType | None) -> None:
        del frame
        if came:
            signal.signal(signum, signal.SIG_DFL)
            signal.raise_signal(signum)
        came.append(signum)
        line = "\nstopping after these epochs, with a checkpoint; once more: at once\n"
        with contextlib.suppress(OSError):  # a closed terminal
            os.write(2, line.encode())

    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    before = {signum: signal.signal(signum, note) for signum in SIGNALS}
    try:
        yield lambda: came[0] if came else None
    finally:
        for signum, handler in before.items():
            # None: it was not set from Python, and cannot be given back.
            signal.signal(signum, signal.SIG_DFL if handler is None else handler)
