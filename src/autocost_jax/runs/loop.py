"""The host's loop around chunks of epochs: metrics, checkpoints, resuming.

Searches and sweeps run in it. Of several processes only the first writes: for the
others the run directory is None.
"""

import io
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import jax
import numpy as np

from autocost_jax.population import Population
from autocost_jax.runs import cluster
from autocost_jax.runs.directory import RunDir, check_free_space, estimate_bytes
from autocost_jax.runs.progress import Display
from autocost_jax.runs.stopping import Stopped, noted_signals

CHECKPOINT_SECONDS = 15.0  # at least, between two checkpoints within a stage


class Chunk(NamedTuple):
    """What a chunk of epochs has left.

    Attributes:
      state: what a checkpoint holds; its `training` is on the devices.
      first: number of the chunk's first epoch in the run.
      rows: of metrics.jsonl, one an epoch.
      position: facts of the checkpoint, see `RunDir.save_checkpoint`.
      is_end: whether a stage, or the run, ends here.
    """

    state: Any
    first: int
    rows: list[dict[str, Any]]
    position: dict[str, Any]
    is_end: bool


def metric_rows(
    algorithms: Sequence[str], metrics: Sequence[dict[str, np.ndarray]]
) -> list[dict[str, Any]]:
    """A row "ALGORITHM/METRIC": [N] for each of K epochs of metrics [K, N]."""
    count = len(next(iter(metrics[0].values())))
    return [
        {
            f"{name}/{key}": value[k]
            for name, group in zip(algorithms, metrics, strict=True)
            for key, value in group.items()
        }
        for k in range(count)
    ]


def start(
    run: RunDir | None, path: Path, state: Any, display: Display, resume: bool
) -> tuple[Any, bool]:
    """The state to go on with: that of the newest checkpoint, or the one given.

    Args:
      run: the open run directory.
      path: its place.
      state: of a run that begins; also the template of the checkpoint.
      display: told of warnings.
      resume: whether to look for a checkpoint.

    Returns:
      The state, and whether it comes from a checkpoint.
    """
    checkpoint = found = None
    if run is not None:
        check_free_space(path, 4 * estimate_bytes(state))
    if resume:
        checkpoint = run and run.resume(state)
        found = cluster.share(checkpoint and checkpoint.tree, state)
        if found is None:
            display.say(f"{path} has no checkpoint yet: starting again")
        for line in checkpoint.warnings if checkpoint else ():
            display.say(line)
    if run is not None:
        step = checkpoint.step if checkpoint else None
        hint = run.start_tensorboard(purge_step=step)
        if hint:
            display.say(hint)
    return (state if found is None else found), found is not None


def compile_ahead(
    population: Population, training: Any, slots: Any, display: Display
) -> None:
    """Compile the program of a run before its first chunk, and say so meanwhile."""
    begun = time.monotonic()
    with display.working("compiling the population program"):
        population.compile(training, slots)
    display.say(f"compiled in {time.monotonic() - begun:.1f} s")


def keep_chunks(
    run: RunDir | None,
    path: Path,
    chunks: Iterable[Chunk],
    state: Any,
    fetch: Callable[[Any], Any],
) -> Any:
    """Train by taking chunk after chunk, and write down what each has left.

    Args:
      run: the open run directory.
      path: its place.
      chunks: made as they are asked for.
      state: before the first one.
      fetch: pytree -> the same in this process's memory.

    Returns:
      The last state, its training fetched.

    Raises:
      Stopped: Ctrl-C or another signal to stop has come; a checkpoint has been written.
    """
    saved_at = -np.inf  # the first chunk is kept, whatever comes
    with noted_signals() as signal_that_came:
        for chunk in chunks:
            state = chunk.state
            if run is not None:
                for k, row in enumerate(chunk.rows):
                    run.log_metrics(row, chunk.first + k)
            is_due = time.monotonic() - saved_at >= CHECKPOINT_SECONDS
            is_due |= chunk.is_end or signal_that_came() is not None
            if is_due or jax.process_count() > 1:  # clocks differ, all must take part
                saved = state.replace(training=fetch(state.training))
                if run is not None:
                    after = chunk.first + len(chunk.rows)
                    run.save_checkpoint(saved, after, chunk.position)
                saved_at = time.monotonic()
                if (signum := signal_that_came()) is not None:
                    raise Stopped(signum, path)
    return state.replace(training=fetch(state.training))


def useful_devices(
    devices: Sequence[Any] | None, num_slots: int, what: str
) -> list[Any]:
    """Devices that have a slot of their own; more would only train copies.

    Args:
      devices: those that may be used; default: the first one.
      num_slots: of the largest group.
      what: the slots are called in an error.

    Raises:
      ValueError: if some process would be without a slot.
    """
    chosen = list(devices or jax.devices()[:1])[:num_slots]
    if len({device.process_index for device in chosen}) < jax.process_count():
        raise ValueError(
            f"{jax.process_count()} processes are more than the {num_slots} {what} "
            "can be dealt to"
        )
    return chosen


def output() -> TextIO:
    """Where this process prints: of several only the first does."""
    return sys.stdout if cluster.is_first() else io.StringIO()
