"""The run directory: its configuration, metrics, checkpoints and artifacts.

    config.yaml       the resolved configuration and the facts of the run
    metrics.jsonl     one strict JSON object a line; TensorBoard events in tensorboard/
    checkpoints/      the last three, see `checkpoints`
    stage_NN.npz      what a finished stage left
    cost.npz, .json   the best cost and its card
    policies/*.npz    flat parameters
    lock              held while a run writes here

`RunDir` writes all of it but the report. JSON knows no non-finite numbers:
in metrics.jsonl and cost.json they are the strings "NaN", "Infinity" and "-Infinity".
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from autocost_jax.config import SearchConfig
from autocost_jax.files import (
    TEMPORARY,
    ArraySpec,
    DiskFullError,
    RunDirError,
    check_free_space,
    disk_errors,
    load_arrays,
    lock_directory,
    remove,
    remove_temporaries,
    require_no_link,
    save_arrays,
    write_atomic,
)
from autocost_jax.runs import checkpoints, cluster
from autocost_jax.runs.checkpoints import Checkpoint, estimate_bytes
from autocost_jax.runs.config_files import (
    CONFIG,
    FORMAT,
    METRICS,
    changed_facts,
    config_hash,
    first_difference,
    from_dict,
    list_stages,
    read_config,
    read_document,
    read_metrics,
    run_facts,
    to_dict,
    to_json,
)

__all__ = [
    "ArraySpec",
    "Checkpoint",
    "DiskFullError",
    "RunDir",
    "RunDirError",
    "check_free_space",
    "config_hash",
    "estimate_bytes",
    "from_dict",
    "list_stages",
    "load_arrays",
    "open_run",
    "read_config",
    "read_metrics",
    "run_facts",
    "save_arrays",
    "to_dict",
    "write_atomic",
]


class RunDir:
    """A run directory that this process may write to, until it is closed.

    Make one with `RunDir.create` or `RunDir.open` and use it in a `with` statement.
    With several processes only the first may have one.

    Attributes:
      path: the directory.
      config: the run's configuration; of a resumed run as it is now asked for.
      facts: the facts recorded at its start.
      warnings: lines the user should see, from opening it.
    """

    def __init__(
        self, path: Path, config: Any, facts: dict, lock: tuple[int, bool], digest: str
    ) -> None:
        self.path = path
        self.config = config
        self.facts = facts
        self.warnings: list[str] = []
        self._hash = digest  # of the recorded config, which its checkpoints carry
        self._lock, is_locked = lock
        if not is_locked:
            self.warnings.append(
                f"{path} is on a file system without locks: nothing keeps a second "
                "process out of it"
            )
        self._metrics: FileIO | None = None
        self._events: Any = None

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: Any,
        facts: dict[str, Any] | None = None,
        overwrite: bool = False,
    ) -> Self:
        """Start a run in a new or empty directory, or in place of an earlier run.

        Args:
          path: made with its parents if it does not exist.
          config: the resolved configuration, a frozen dataclass.
          facts: see `run_facts`; None collects them.
          overwrite: delete the files of the run that is there; never anything else.

        Raises:
          RunDirError: the directory holds a run or something else, or is in use.
        """
        import yaml

        path = Path(path)
        facts = run_facts(getattr(config, "seed", None)) if facts is None else facts
        document = {"format": FORMAT, "config": to_dict(config), "facts": facts}
        text = yaml.safe_dump(document, sort_keys=False)
        _check_new(path, overwrite)
        lock = lock_directory(path)
        try:
            _check_new(path, overwrite)  # again: another process may have been faster
            for old in _run_files(path):
                remove(old)
            write_atomic(path / CONFIG, text.encode())
        except BaseException:
            os.close(lock[0])
            raise
        return cls(path, config, facts, lock, config_hash(config))

    @classmethod
    def open(cls, path: str | Path, config: Any = None) -> Self:
        """Open a run to go on with it.

        Args:
          path: the directory.
          config: what the user asks for now; None takes the run's own. It may differ
            in `config_files.MAY_DIFFER`; the recorded one stays as it is.

        Raises:
          RunDirError: not a run, in use, or `config` is not the run's: the first
            other field that differs is named with both values.
        """
        path = Path(path)
        kind = SearchConfig if config is None else type(config)
        recorded, facts = read_config(path, kind)
        config = recorded if config is None else config
        difference = first_difference(recorded, config)
        if difference is not None:
            name, old, new = difference
            raise RunDirError(
                f"{path} was started with {name}={old}, asked for {name}={new}: "
                "resume with the run's own configuration, or start a new run"
            )
        run = cls(path, config, facts, lock_directory(path), config_hash(recorded))
        for folder in ("", "checkpoints", "policies", "report", "replays"):
            remove_temporaries(path / folder)
        changed = changed_facts(facts, run_facts())
        if changed:
            run.warnings.append(
                f"{path} was started with other versions or devices, so it will not "
                f"end bit for bit as it would have: {changed}"
            )
        return run

    def close(self) -> None:
        """Flush everything and let other processes in."""
        if self._lock < 0:
            return
        try:
            self._sync_metrics()
            if self._metrics is not None:
                self._metrics.close()
            if self._events is not None:
                self._events.close()
        finally:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Self:
        """Return the run itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the run."""
        self.close()

    def start_tensorboard(self, purge_step: int | None = None) -> str | None:
        """Write TensorBoard events too, from now on.

        Args:
          purge_step: on resume the first step that is done again; TensorBoard hides
            earlier events from there on.

        Returns:
          None, or a hint for the user if tensorboardX is not installed.
        """
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            return "no TensorBoard events: pip install tensorboardX"
        folder = str(self.path / "tensorboard")
        self._events = SummaryWriter(folder, purge_step=purge_step)
        return None

    def log_metrics(self, row: Mapping[str, Any], step: int) -> None:
        """Append a row to metrics.jsonl; TensorBoard gets means of finite entries.

        Args:
          row: numbers, strings, arrays, and lists or dicts of them; "step" is added.
          step: place of the row on TensorBoard's axis.
        """
        line = json.dumps(to_json({"step": step, **row}), allow_nan=False)
        with disk_errors(self.path / METRICS):
            if self._metrics is None:
                # Unbuffered: what a full disk refused must not come back in close().
                require_no_link(self.path / METRICS)
                self._metrics = (self.path / METRICS).open("ab", buffering=0)
            _append(self._metrics, line.encode() + b"\n")
            if self._events is None:
                return
            for name, value in row.items():
                array = np.asarray(value)
                # A NaN says "no such state"; tensorboardX would print a warning.
                known = array[np.isfinite(array)] if array.dtype.kind in "biuf" else ()
                if len(known):
                    self._events.add_scalar(name, float(np.mean(known)), step)

    def save_checkpoint(
        self, tree: Any, step: int, extra: dict[str, Any] | None = None
    ) -> Path:
        """Write a checkpoint that also marks where metrics.jsonl ends now.

        Write the artifacts of a finished stage before it: what a checkpoint has
        passed is not done again.

        Args:
          tree: pytree of jax or numpy arrays, typed keys included.
          step: grows from one checkpoint to the next.
          extra: strict JSON facts such as stage and epoch, given back by `resume`.

        Raises:
          DiskFullError: the disk is full; earlier checkpoints are intact.
        """
        metrics_bytes = self._sync_metrics()
        return checkpoints.save(
            self.path / "checkpoints",
            tree,
            step,
            config_hash=self._hash,
            metrics_bytes=metrics_bytes,
            extra=extra or {},
        )

    def resume(self, template: Any) -> Checkpoint | None:
        """Load the newest whole checkpoint and cut the metrics back to it.

        Args:
          template: pytree of arrays or `jax.ShapeDtypeStruct`s, as was saved.

        Returns:
          The checkpoint, whose `warnings` the user should see, or None if the run
          ended before the first one and starts again.

        Raises:
          RunDirError: all checkpoints are broken, or the template does not fit.
        """
        folder = self.path / "checkpoints"
        checkpoint = checkpoints.load_latest(folder, template, self._hash)
        warning = self.truncate_metrics(checkpoint.metrics_bytes if checkpoint else 0)
        if checkpoint is not None and warning is not None:
            checkpoint.warnings.append(warning)
        return checkpoint

    def damages(self, num_stages: int) -> list[str]:
        """What of a resumed run is broken and cannot be made again, in words.

        Args:
          num_stages: stages that have left their file.
        """
        files = [self.path / f"stage_{number:02d}.npz" for number in range(num_stages)]
        found = []
        for read, path in [
            *((load_arrays, f) for f in files),
            (read_metrics, self.path),
        ]:
            try:
                read(path)
            except RunDirError as error:
                found.append(str(error))
        return found

    def truncate_metrics(self, metrics_bytes: int) -> str | None:
        """Cut metrics.jsonl to a length; returns a warning if it was shorter."""
        file = self.path / METRICS
        if self._metrics is not None:
            self._metrics.close()
            self._metrics = None
        require_no_link(file)
        length = file.stat().st_size if file.exists() else 0
        if length < metrics_bytes:
            return f"{file} lost {metrics_bytes - length} bytes since the checkpoint"
        if length > metrics_bytes:
            os.truncate(file, metrics_bytes)
        return None

    def write_stage(self, stage: int, arrays: Mapping[str, Any]) -> Path:
        """Write stage_NN.npz."""
        file = self.path / f"stage_{stage:02d}.npz"
        save_arrays(file, arrays)
        return file

    def write_cost(self, arrays: Mapping[str, Any], card: Mapping[str, Any]) -> Path:
        """Write cost.npz and its card, cost.json."""
        save_arrays(self.path / "cost.npz", arrays)
        self.write_json("cost", card)
        return self.path / "cost.npz"

    def write_policy(self, name: str, params: Any) -> Path:
        """Write policies/NAME.npz, the parameters as `files.flatten` names them."""
        file = self.path / "policies" / f"{name}.npz"
        save_arrays(file, params)
        return file

    def write_arrays(self, name: str, arrays: Mapping[str, Any]) -> Path:
        """Write NAME.npz."""
        save_arrays(self.path / f"{name}.npz", arrays)
        return self.path / f"{name}.npz"

    def write_json(self, name: str, value: Mapping[str, Any]) -> Path:
        """Write NAME.json."""
        file = self.path / f"{name}.json"
        text = json.dumps(to_json(value), indent=2, allow_nan=False)
        write_atomic(file, text.encode() + b"\n")
        return file

    def _sync_metrics(self) -> int:
        file = self.path / METRICS
        with disk_errors(file):
            if self._events is not None:
                self._events.flush()
            if self._metrics is not None:
                os.fsync(self._metrics.fileno())
            return file.stat().st_size if file.exists() else 0


@contextlib.contextmanager
def open_run(
    path: Path, config: Any, *, resume: bool, overwrite: bool, num_episodes: int
) -> Iterator[RunDir | None]:
    """The run directory of a new or resumed run; None where another process has it.

    Raises:
      RunDirError: see `RunDir.create` and `RunDir.open`.
    """
    if resume and overwrite:
        raise ValueError("resume goes on with a run, overwrite starts over: give one")
    if not cluster.is_first():
        yield None
    elif resume:
        with RunDir.open(path, config) as run:
            yield run
    else:
        facts = run_facts(getattr(config, "seed", None))
        facts["num_episodes"] = num_episodes
        with RunDir.create(path, config, facts, overwrite) as run:
            yield run


def _run_files(path: Path) -> list[Path]:
    """What a run owns in its directory, but for its config and its lock."""
    names = (METRICS, "tensorboard", "checkpoints", "policies", "report")
    arrays = ("stage_*.npz", "cost.npz", "replay*.npz")
    texts = ("cost.json", "summary.json", "evaluation.json")
    patterns = (*names, *arrays, *texts, f"{TEMPORARY}*")
    return [file for pattern in patterns for file in path.glob(pattern)]


def _append(file: FileIO, line: bytes) -> None:
    """Append all of a line or, if that fails, nothing."""
    length = os.fstat(file.fileno()).st_size
    try:
        while line:
            line = line[file.write(line) :]
    except OSError:
        file.truncate(length)
        raise


def _check_new(path: Path, overwrite: bool) -> None:
    if not path.exists():
        return
    if not path.is_dir():
        raise RunDirError(f"{path} is a file, not a directory")
    names = {file.name for file in path.iterdir()} - {"lock"}
    if CONFIG in names and not overwrite:
        raise RunDirError(
            f"{path} already holds a run: resume it, or choose another directory"
        )
    if CONFIG in names:
        read_document(path)  # raises unless it is a run
    elif any(not name.startswith(TEMPORARY) for name in names):
        raise RunDirError(
            f"{path} is not empty and not a run: choose another directory"
        )
