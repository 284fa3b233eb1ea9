"""A run that is asked to stop ends its epochs, keeps them, and says how to go on."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import pytest
from flax import struct

from autocost_jax.commandline import guarded
from autocost_jax.runs import stopping
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


@pytest.fixture(autouse=True)
def heeded():
    """Who started the tests may ignore signals, as a shell in the background does."""
    before = {s: signal.signal(s, signal.default_int_handler) for s in SIGNALS}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


def train(run, chunks):
    return keep_chunks(run, Run.path, chunks, State(jnp.float32(-1)), lambda x: x)


def handlers():
    return [signal.getsignal(signum) for signum in SIGNALS]


@pytest.mark.parametrize("signum", SIGNALS)
def test_the_epochs_at_hand_end_whole_and_are_kept(signum, capfd):
    run, before = Run(), handlers()
    with pytest.raises(Stopped) as stop:
        train(run, chunks(signum, at=3))
    assert (stop.value.signum, stop.value.path) == (signum, run.path)
    assert isinstance(stop.value, KeyboardInterrupt)  # `except Exception` lets it pass
    assert run.rows == list(range(8))
    assert run.saved[-1] == (8, 3.0, {"epoch": 8})
    assert handlers() == before
    assert "once more: at once" in capfd.readouterr().err


def test_without_a_signal_all_chunks_are_taken():
    run, before = Run(), handlers()
    end = train(run, chunks(0, at=9))
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


def test_a_process_without_a_directory_stops_as_well():
    with pytest.raises(Stopped):
        train(None, chunks(signal.SIGTERM, at=4))  # the last one


def test_what_was_ignored_stays_ignored():
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        end = train(Run(), chunks(signal.SIGHUP, at=1))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert float(end.training) == 4.0


BUSY = """
import hashlib, sys
sys.path.append(sys.argv[1])  # the module alone, without all of JAX
import stopping
stopping.ECHO = float(sys.argv[2])
with stopping.noted_signals():
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # like a compiled program
"""


@pytest.mark.parametrize(
    ("echo", "status"), [("0", 128 + signal.SIGTERM), ("60", None)]
)
def test_a_second_signal_ends_a_busy_program_at_once(echo, status):
    """An echo of the first does not."""
    folder = str(Path(stopping.__file__).parent)
    words = [sys.executable, "-c", BUSY, folder, echo]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGTERM)
        assert b"once more" in process.stderr.readline() + process.stderr.readline()
        time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=3)
        except subprocess.TimeoutExpired:
            process.kill()
            assert status is None
        else:
            assert process.returncode == status


def test_the_command_line_says_how_to_go_on(capsys):
    def stopped():
        raise Stopped(signal.SIGTERM, Run.path)

    with pytest.raises(SystemExit) as stop:
        guarded(stopped, "autocost train")
    assert stop.value.code == 143
    line = "go on with: autocost train --resume --out 'runs/a toy'\n"
    assert capsys.readouterr().err.endswith(line)
