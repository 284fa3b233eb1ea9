"""Being asked to stop: by Ctrl-C, by a scheduler, by a closed terminal.

While epochs are computed a signal is only noted, so that the epochs at hand end whole
and a checkpoint can be written. A second one ends the program at once, even while the
main thread is busy in compiled code: a thread of its own watches for it.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

# SIGHUP is not known on Windows.
SIGNALS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP")
    if hasattr(signal, name)
)
ECHO = 1.0  # seconds: a closing terminal and some schedulers send a signal twice
FIRST = b"\nstopping after these epochs, with a checkpoint; once more: at once\n"
SHOW_CURSOR = b"\x1b[?25h"  # which a live display has hidden


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
    """Signals within are noted, not acted on, unless another comes after a second.

    A signal that the program was started to ignore (`nohup`, a job in the background)
    stays ignored. Only the main thread can note signals; in any other they do what they
    did before.

    Yields:
      () -> number of the first signal that has come, None before.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    came: list[int] = []

    def note(signum: int, frame: FrameType | None) -> None:
        del frame
        came.append(signum)

    heeded = [s for s in SIGNALS if signal.getsignal(s) is not signal.SIG_IGN]
    before = {signum: signal.signal(signum, note) for signum in heeded}
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    former = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    watcher = threading.Thread(target=_watch, args=(reader, heeded), daemon=True)
    watcher.start()
    try:
        yield lambda: came[0] if came else None
    finally:
        signal.set_wakeup_fd(former)
        for signum, handler in before.items():
            # None: it was not set from Python, and cannot be given back.
            signal.signal(signum, signal.SIG_DFL if handler is None else handler)
        os.close(writer)  # the watcher reads the end of the pipe
        watcher.join()
        os.close(reader)


def _watch(reader: int, heeded: list[int]) -> None:
    """Answer the signals whose numbers come through a pipe."""
    first = None
    while number := os.read(reader, 1):
        if number[0] not in heeded:
            continue
        if first is None:
            first = time.monotonic()
            _tell(FIRST)
        elif time.monotonic() - first > ECHO:
            _tell(SHOW_CURSOR if os.isatty(2) else b"")
            os._exit(128 + number[0])


def _tell(line: bytes) -> None:
    with contextlib.suppress(OSError):  # a closed terminal
        os.write(2, line)
