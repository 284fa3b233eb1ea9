"""A run that is asked to stop ends its epochs, keeps them, and says how to go on."""

import signal
import subprocess
import sys
import threading
from pathlib import Path

import jax.numpy as jnp
import pytest
from flax import struct

from autocost_jax.commandline import guarded
from autocost_jax.runs.loop import Chunk, keep_chunks
from autocost_jax.runs.stopping import SIGNALS, Stopped, noted_signals


class State(struct.PyTreeNode):
    """What a toy run keeps."""

    training: jnp.ndarray


class Run:
    """A run directory that remembers what was written."""

    path = Path("runs/a toy")

    def __init__(self):
        self.saved, self.rows = [], []

    def log_metrics(self, row, step):
        self.rows.append(step)

    def save_checkpoint(self, tree, step, extra):
        self.saved.append((step, float(tree.training), extra))


def chunks(signum, at, count=5):
    """Chunks of two epochs; the signal comes while one of them is computed."""
    for i in range(count):
        if i == at:
            signal.raise_signal(signum)
        yield Chunk(State(jnp.float32(i)), 2 * i, [{}, {}], {"epoch": 2 * i + 2}, False)


def handlers():
    return [signal.getsignal(signum) for signum in SIGNALS]


@pytest.mark.parametrize("signum", SIGNALS)
def test_the_epochs_at_hand_end_whole_and_are_kept(signum, capfd):
    run, before = Run(), handlers()
    with pytest.raises(Stopped) as stop:
        keep_chunks(run, chunks(signum, at=3), State(jnp.float32(-1)), lambda x: x)
    assert (stop.value.signum, stop.value.path) == (signum, run.path)
    assert isinstance(stop.value, KeyboardInterrupt)  # `except Exception` lets it pass
    assert run.rows == list(range(8))
    assert run.saved[-1] == (8, 3.0, {"epoch": 8})
    assert handlers() == before
    assert "once more: at once" in capfd.readouterr().err


def test_without_a_signal_all_chunks_are_taken():
    run, before = Run(), handlers()
    end = keep_chunks(run, chunks(0, at=9), State(jnp.float32(-1)), lambda x: x)
    assert float(end.training) == 4.0
    assert run.rows == list(range(10))
    assert handlers() == before


def test_only_the_main_thread_notes_signals():
    came = []

    def other():
        with noted_signals() as signal_that_came:
            came.append(signal_that_came())

    before = handlers()
    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert came == [None]
    assert handlers() == before


def test_a_second_signal_ends_the_program_at_once():
    program = (
        "import signal\n"
        "from autocost_jax.runs.stopping import noted_signals\n"
        "with noted_signals():\n"
        "    for _ in range(2):\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
        "    print('still there')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True)
    assert done.returncode == -signal.SIGTERM
    assert done.stdout == b""
    assert done.stderr.count(b"once more") == 1


def test_the_command_line_says_how_to_go_on(capsys):
    def stopped():
        raise Stopped(signal.SIGTERM, Run.path)

    with pytest.raises(SystemExit) as stop:
        guarded(stopped, "autocost train")
    assert stop.value.code == 143
    line = "go on with: autocost train --resume --out 'runs/a toy'\n"
    assert capsys.readouterr().err.endswith(line)
