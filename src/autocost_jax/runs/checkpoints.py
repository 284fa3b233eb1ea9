"""Checkpoints that exist only if every byte of them is right.

    checkpoints/step_00000012/arrays/...      what orbax writes
                              manifest.json   sha256 of every file, and the facts

Everything is written under a temporary name, the manifest last, and the directory
renamed at the end. A checkpoint without a manifest that matches does not exist.
"""

import contextlib
import hashlib
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from autocost_jax.files import (
    TEMPORARY,
    RunDirError,
    check_free_space,
    disk_errors,
    flatten,
    fsync,
    named_leaves,
    remove,
    stored_like,
    unflatten,
    write_atomic,
)

FORMAT = 1
KEEP = 3
_STEP = "step_"
_MANIFEST = "manifest.json"
# Measured on small trees: orbax's own files, and its metadata for one array.
_BYTES_PER_CHECKPOINT, _BYTES_PER_ARRAY = 16_384, 1_024


class Checkpoint(NamedTuple):
    """A checkpoint that was read and verified.

    Attributes:
      tree: the pytree, in the structure of the template.
      step: the step that it was saved under.
      metrics_bytes: length of metrics.jsonl when it was saved.
      extra: the caller's own facts (stage, epoch, ...).
      warnings: one line for each newer checkpoint that was broken.
    """

    tree: Any
    step: int
    metrics_bytes: int
    extra: dict[str, Any]
    warnings: list[str]


def estimate_bytes(template: Any) -> int:
    """Bytes on disk that one checkpoint of such a pytree takes, at most.

    While a run writes, `KEEP` + 1 of them are there.
    """
    leaves = stored_like(template).values()
    data = sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)
    return data + len(leaves) * _BYTES_PER_ARRAY + _BYTES_PER_CHECKPOINT


def save(
    directory: Path,
    tree: Any,
    step: int,
    *,
    config_hash: str,
    metrics_bytes: int,
    extra: dict[str, Any],
) -> Path:
    """Write a checkpoint, then delete those it supersedes.

    Kept are the last `KEEP` up to `step`; a later one can only be a broken one that
    an earlier one was used for, and goes.

    Args:
      directory: the `checkpoints` directory.
      tree: pytree of jax or numpy arrays, typed keys included.
      step: grows from one checkpoint to the next.
      config_hash: of the run's configuration.
      metrics_bytes: length of metrics.jsonl, already flushed to the disk.
      extra: strict JSON, given back by `load_latest`.

    Raises:
      DiskFullError: the disk is full; the checkpoints before this one are intact.
      RunDirError: a leaf is not an array.
    """
    final = directory / f"{_STEP}{step:08d}"
    temporary = directory / f"{TEMPORARY}{final.name}"
    facts = {
        "format": FORMAT,
        "step": step,
        "config_hash": config_hash,
        "metrics_bytes": metrics_bytes,
        "extra": extra,
        "arrays": _describe(tree),
    }
    arrays = flatten(tree)
    with disk_errors(final):
        directory.mkdir(parents=True, exist_ok=True)
        remove(temporary)
        check_free_space(directory, estimate_bytes(tree))
        try:
            _write_arrays(temporary / "arrays", arrays)
            files = _hash_files(temporary, sync=True)
            write_atomic(temporary / _MANIFEST, _dump({**facts, "files": files}))
            # Renamed before it is deleted: a kill leaves no half-deleted checkpoint.
            _discard(final)
            temporary.rename(final)
            fsync(directory)
        except BaseException:
            remove(temporary)
            raise
    steps = list_steps(directory)
    for old in steps:
        if old > step or old in [s for s in steps if s <= step][:-KEEP]:
            _discard(directory / f"{_STEP}{old:08d}")
    return final


def load_latest(directory: Path, template: Any, config_hash: str) -> Checkpoint | None:
    """The newest checkpoint that is whole, or None if none was ever written.

    Args:
      directory: the `checkpoints` directory.
      template: pytree of arrays or `jax.ShapeDtypeStruct`s, see `arrays.unflatten`.
      config_hash: of the run's configuration.

    Raises:
      RunDirError: if all are broken, or a whole one does not fit the template.
    """
    steps = list_steps(directory)
    warnings: list[str] = []
    for step in reversed(steps):
        path = directory / f"{_STEP}{step:08d}"
        try:
            manifest = _verify(path, step, config_hash)
            arrays = _read_arrays(path / "arrays")
        except Exception as error:  # whatever is wrong with it, the one before is used
            reason = (str(error) or type(error).__name__).splitlines()[0]
            warnings.append(f"checkpoint {path} is broken: {reason}; not used")
            continue
        _check_description(path, manifest["arrays"], _describe(template))
        empty = {
            name: np.zeros(like.shape, like.dtype)
            for name, like in stored_like(template).items()
            if 0 in like.shape
        }
        return Checkpoint(
            tree=unflatten({**arrays, **empty}, template),
            step=step,
            metrics_bytes=manifest["metrics_bytes"],
            extra=manifest["extra"],
            warnings=warnings,
        )
    if steps:
        raise RunDirError(f"no checkpoint is whole: {' | '.join(warnings)}")
    return None


def list_steps(directory: Path) -> list[int]:
    """Steps that have a checkpoint directory, whole or not, in rising order."""
    names = [path.name.removeprefix(_STEP) for path in directory.glob(f"{_STEP}*")]
    return sorted(int(name) for name in names if name.isdecimal())


def _describe(tree: Any) -> dict[str, dict[str, Any]]:
    """Shape and dtype by path; the dtype of keys names their PRNG (`key<fry>`)."""
    return {
        name: {"shape": list(leaf.shape), "dtype": str(leaf.dtype)}
        for name, leaf in named_leaves(tree).items()
    }


def _check_description(path: Path, got: dict, wanted: dict) -> None:
    for name in [*wanted, *got]:
        if got.get(name) != wanted.get(name):
            has, needs = (
                f"{leaf['dtype']}{leaf['shape']}" if leaf else "nothing"
                for leaf in (got.get(name), wanted.get(name))
            )
            raise RunDirError(
                f"checkpoint {path} does not fit this program: "
                f"{name} must be {needs}, got {has}"
            )


def _verify(path: Path, step: int, config_hash: str) -> dict[str, Any]:
    raw = (path / _MANIFEST).read_bytes()
    manifest = json.loads(raw)
    if _dump(manifest) != raw:
        raise RunDirError("manifest.json was changed")
    for name, wanted in (
        ("format", FORMAT),
        ("step", step),
        ("config_hash", config_hash),
    ):
        if manifest[name] != wanted:
            raise RunDirError(f"{name} must be {wanted}, got {manifest[name]}")
    files = _hash_files(path)
    for name in sorted({*files, *manifest["files"]}):
        if files.get(name) != manifest["files"].get(name):
            state = "was changed" if name in files else "is missing"
            raise RunDirError(f"{name} {state}")
    return manifest


def _dump(manifest: dict[str, Any]) -> bytes:
    # The digest guards the manifest itself against a flipped byte.
    body = {name: value for name, value in manifest.items() if name != "sha256"}
    text = json.dumps(body, sort_keys=True, allow_nan=False)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return json.dumps(
        {**body, "sha256": digest}, sort_keys=True, indent=1, allow_nan=False
    ).encode()


def _hash_files(root: Path, sync: bool = False) -> dict[str, str]:
    """The sha256 of every file below but the manifest; optionally flushed to disk."""
    files = {}
    for folder, _, names in os.walk(root, topdown=False):
        for path in (Path(folder, name) for name in sorted(names)):
            if sync:
                fsync(path)
            if path != root / _MANIFEST:
                with path.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                files[path.relative_to(root).as_posix()] = digest
        if sync:
            fsync(Path(folder))
    return files


def _discard(path: Path) -> None:
    if path.exists():
        remove(path.rename(path.with_name(f"{TEMPORARY}old-{path.name}")))


@contextlib.contextmanager
def _checkpointer() -> Iterator[ocp.Checkpointer]:
    """A synchronous orbax checkpointer of this process alone, without log lines."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # an error reaches the user as our exception
    options = ocp.options.MultiprocessingOptions()
    if jax.process_count() > 1:  # only the writer is here: orbax must not wait
        this = jax.process_index()
        options = ocp.options.MultiprocessingOptions(this, {this}, f"process{this}")
    try:
        with ocp.Checkpointer(
            ocp.StandardCheckpointHandler(multiprocessing_options=options),
            multiprocessing_options=options,
        ) as checkpointer:
            yield checkpointer
    finally:
        logger.setLevel(level)


def _write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    # Orbax refuses arrays without entries; the manifest says all there is of them.
    filled = {name: array for name, array in arrays.items() if array.size}
    with _checkpointer() as checkpointer:
        checkpointer.save(path.absolute(), args=ocp.args.StandardSave(filled))


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    with _checkpointer() as checkpointer:
        arrays = checkpointer.restore(path.absolute(), args=ocp.args.StandardRestore())
    return {name: np.asarray(array) for name, array in arrays.items()}
