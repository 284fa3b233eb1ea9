"""One run in two processes on this machine: the same numbers, and a clear end."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from autocost_jax.commandline import guarded
from autocost_jax.runs import cluster
from autocost_jax.runs.directory import read_metrics

FLAGS = ["--preset", "smoke", "--physics", "closed_form", "--eval-episodes", "4"]
WAIT = 400  # seconds until a process counts as hung
SEARCH = ["autocost_jax.evolve"]
TABLE = ["autocost_jax.cli", "train"]
NUMBERS = ("theta", "cost", "ep_return", "order", "elites", "archive")


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Processes share a compilation cache."""
    cache = str(tmp_path_factory.mktemp("cache"))
    return os.environ | {"JAX_COMPILATION_CACHE_DIR": cache}


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def start(
    out: Path,
    environment,
    *flags: str,
    index: int | None = None,
    port: int = 0,
    command: list[str] = SEARCH,
):
    words = [sys.executable, "-m", *command, "--out", str(out), *flags]
    if index is not None:
        words += ["--coordinator", f"127.0.0.1:{port}"]
        words += ["--num-processes", "2", "--process-id", str(index)]
    process = subprocess.Popen(
        words,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if index is not None:  # one core, which is one device, long before it counts them
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(process.pid, {cores[index % len(cores)]})
    return process


def start_both(out: Path, environment, *flags: str, command: list[str] = SEARCH):
    port = free_port()
    return [
        start(out, environment, *flags, index=index, port=port, command=command)
        for index in range(2)
    ]


@pytest.fixture(scope="module")
def both(tmp_path_factory, environment):
    """A run in two processes: its directory and what each of them said."""
    out = tmp_path_factory.mktemp("runs") / "both"
    processes = start_both(out, environment, *FLAGS)
    said = [process.communicate(timeout=WAIT)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    return out, said


@pytest.mark.slow
def test_only_the_first_process_speaks_and_writes(both):
    out, (first, second) = both
    assert "open " in first
    lines = [line for line in second.splitlines() if not line.startswith("[Gloo]")]
    assert lines == []
    assert (out / "report" / "index.html").exists()
    assert len(read_metrics(out)) == 6  # one row an epoch, not two


@pytest.mark.slow
def test_it_is_the_search_of_one_process(both, environment, tmp_path):
    """The same slots on two devices of one process; sums in the same order."""
    process = start(tmp_path / "one", environment, *FLAGS, "--devices", "2")
    said, _ = process.communicate(timeout=WAIT)
    if "devices must be in [1, 1]" in said:
        pytest.skip("one core")
    assert process.returncode == 0, said
    for name in ("stage_00.npz", "stage_01.npz"):
        one, two = np.load(tmp_path / "one" / name), np.load(both[0] / name)
        for key in NUMBERS:
            np.testing.assert_allclose(
                two[key], one[key], rtol=1e-4, atol=1e-5, err_msg=f"{name} {key}"
            )


@pytest.mark.slow
def test_a_crash_ends_the_others_and_one_process_can_go_on(environment, tmp_path):
    """In one line and soon; then the run is resumed on another number of devices."""
    out = tmp_path / "crashed"
    flags = [*FLAGS, "--num-epochs", "60", "--num-finalists", "0"]
    first, second = start_both(out, environment, *flags)
    deadline = time.monotonic() + WAIT
    while not list(out.glob("checkpoints/step_*")):
        assert first.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    second.send_signal(signal.SIGKILL)
    second.communicate()
    said, _ = first.communicate(timeout=60)
    assert first.returncode == 1, said
    assert said.splitlines()[-1].startswith("python -m autocost_jax.evolve: ")
    again = ("--resume", "--devices", "1", "--eval-episodes", "4")
    resumed = start(out, environment, *again)
    said, _ = resumed.communicate(timeout=WAIT)
    assert resumed.returncode == 0, said
    assert "resuming" in said
    assert [row["step"] for row in read_metrics(out)] == list(range(120))


@pytest.mark.parametrize("kind", [ValueError, RuntimeError])
def test_a_lost_peer_is_no_bad_input(kind, capsys):
    """Whichever error JAX makes of it."""

    def fails() -> None:
        raise kind("UNKNOWN: Gloo AllGather failed: Connection reset by peer")

    with pytest.raises(SystemExit) as stopped:
        guarded(fails, "prog")
    assert stopped.value.code == 1
    assert capsys.readouterr().err.startswith("prog: UNKNOWN: Gloo")


@pytest.mark.slow
def test_a_table_in_two_processes_is_that_of_one(environment, tmp_path):
    """`autocost train`: the same numbers, written once; resumed in the middle."""
    flags = ["--preset", "smoke", "--physics", "closed_form", "--num-seeds", "2"]
    flags += ["--algorithms", "ppo", "cpo", "--episodes", "4"]
    both = start_both(tmp_path / "both", environment, *flags, command=TABLE)
    said = [process.communicate(timeout=WAIT)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    alone = start(tmp_path / "one", environment, *flags, command=TABLE)
    assert alone.wait(WAIT) == 0
    scores = [
        json.loads((tmp_path / name / "evaluation.json").read_text())["rows"]
        for name in ("both", "one")
    ]
    assert len(scores[0]) == 4
    for two, one in zip(*scores, strict=True):
        assert two["method"] == one["method"]
        assert two["return_mean"] == pytest.approx(one["return_mean"], abs=1e-3)
        assert two["cost_mean"] == pytest.approx(one["cost_mean"], abs=1e-3)
    lines = [line for line in said[1].splitlines() if not line.startswith("[Gloo]")]
    assert lines == []
    rows = read_metrics(tmp_path / "both")
    assert [row["epoch"] for row in rows] == [0, 1]
    for two, one in zip(rows, read_metrics(tmp_path / "one"), strict=True):
        np.testing.assert_allclose(
            two["cpo/ep_return"], one["cpo/ep_return"], atol=1e-3
        )
    shutil.rmtree(max((tmp_path / "both" / "checkpoints").glob("step_*")))
    again = start_both(
        tmp_path / "both", environment, "--resume", "--episodes", "4", command=TABLE
    )
    said = [process.communicate(timeout=WAIT)[0] for process in again]
    assert [process.returncode for process in again] == [0, 0], said
    assert "after 1 epochs" in said[0]
    assert [row["epoch"] for row in read_metrics(tmp_path / "both")] == [0, 1]


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("need a coordinator", (None, 2, None)),
        ("leave out", ("auto", 2, 0)),
        ("needs num_processes", ("127.0.0.1:1", None, 0)),
        ("process_id", ("127.0.0.1:1", 2, 2)),
        ("HOST:PORT", ("127.0.0.1", 2, 0)),
    ],
)
def test_incomplete_descriptions_are_refused(words, given):
    with pytest.raises(ValueError, match=words):
        cluster.join(*given)


def test_alone_everything_is_shared():
    tree = {"a": np.arange(3)}
    assert cluster.share(tree, tree) is tree
    assert cluster.share(None, tree) is None
    assert cluster.is_first()
    cluster.wait_for_all()
