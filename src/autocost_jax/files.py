"""Durable files, arrays by name and locks: what run directories are made of.

A file either is there whole or is not there: it is written under a temporary name,
flushed to the disk, and renamed last. Pytrees are stored as flat tables
`path -> array`, so reading one back never depends on a Python class.
"""

import contextlib
import errno
import io
import os
import shutil
import socket
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

TEMPORARY = ".tmp-"  # prefix of everything that a kill may leave behind
_DISK_FULL = "No space left on device"  # tensorstore has no errno, only this text
_PRNGS = ("threefry2x32", "rbg", "unsafe_rbg")


class RunDirError(ValueError):
    """A file or directory is not what it should be; the message is one line."""


class DiskFullError(RuntimeError):
    """The disk is full; what was complete before is still complete."""


class ArraySpec(NamedTuple):
    """What an array in a file must look like.

    Attributes:
      shape: each length an int, None (any), or a name that must agree in the file.
      dtype: name of the numpy dtype.
      finite: whether every entry must be finite.
    """

    shape: tuple[int | str | None, ...]
    dtype: str
    finite: bool = False


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn a full disk, however it is reported, into `DiskFullError`."""
    try:
        yield
    except Exception as error:
        code = getattr(error, "errno", None)
        if code in (errno.ENOSPC, errno.EDQUOT) or _DISK_FULL in str(error):
            raise DiskFullError(
                f"the disk is full: could not write {path}; what was complete before "
                "is intact: free some space, then resume"
            ) from error
        raise


def check_free_space(path: Path, num_bytes: int) -> None:
    """Raise `DiskFullError` if fewer than `num_bytes` are free where `path` is."""
    path = Path(path).absolute()
    while not path.exists():
        path = path.parent
    free = shutil.disk_usage(path).free
    if free < num_bytes:
        raise DiskFullError(
            f"the disk is too full: {path} has {free / 1e6:.1f} MB left, "
            f"{num_bytes / 1e6:.1f} MB are needed"
        )


def fsync(path: Path) -> None:
    """Wait until a file, or the entries of a directory, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file that after a crash is either the old one or the new one."""
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(data)
            fsync(temporary)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        fsync(path.parent)


def remove(path: Path) -> None:
    """Delete a file or a directory with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_temporaries(directory: Path) -> None:
    """Delete what a kill in the middle of a write left in a directory."""
    for path in directory.glob(f"{TEMPORARY}*"):
        remove(path)


def is_key(leaf: Any) -> bool:
    """Whether an array, or the description of one, holds typed PRNG keys."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def named_leaves(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree of arrays by path, such as `opt/0/mu/w`.

    Raises:
      RunDirError: if a leaf is not an array of numbers or keys, or a path is double.
    """
    leaves: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        dtype = getattr(leaf, "dtype", None)
        if dtype is None or not (is_key(leaf) or dtype.kind in "biuf"):
            what = type(leaf).__name__ if dtype is None else f"{dtype} array"
            raise RunDirError(f"{name}: only arrays can be stored, got a {what}")
        if name in leaves:
            raise RunDirError(f"two leaves of the tree have the path {name}")
        leaves[name] = leaf
    return leaves


def flatten(tree: Any) -> dict[str, np.ndarray]:
    """A pytree of arrays as a table path -> numpy array; keys as their uint32 data."""
    return {
        name: np.asarray(jax.random.key_data(leaf) if is_key(leaf) else leaf)
        for name, leaf in named_leaves(tree).items()
    }


def stored_like(template: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Shape and dtype of what `flatten` returns, by path, without the data."""
    return {
        name: jax.eval_shape(jax.random.key_data, leaf)
        if is_key(leaf)
        else jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
        for name, leaf in named_leaves(template).items()
    }


def unflatten(arrays: Mapping[str, np.ndarray], template: Any) -> Any:
    """A pytree like `template` out of arrays by path; the inverse of `flatten`.

    Args:
      arrays: what `flatten` returned.
      template: pytree of arrays or `jax.ShapeDtypeStruct`s. A numpy leaf comes back
        as numpy, every other one as a `jax.Array`, keys with the template's PRNG.

    Raises:
      RunDirError: if names, shapes or dtypes differ; it names the first.
    """
    leaves = named_leaves(template)
    _check_names(arrays, leaves)
    for name, like in stored_like(template).items():
        _check_array(name, arrays[name], like.shape, str(like.dtype))
    restored = [_restore(arrays[name], leaf) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(template), restored)


def _restore(value: np.ndarray, leaf: Any) -> Any:
    if is_key(leaf):
        return jax.random.wrap_key_data(jnp.array(value), impl=_prng(leaf.dtype))
    if isinstance(leaf, np.ndarray | np.generic):
        return value
    return jnp.array(value)  # a copy: borrowed numpy memory must not be donated


def _prng(key_dtype: Any) -> str:
    # The dtype, such as `key<fry>`, is all that a ShapeDtypeStruct says of its PRNG.
    for name in _PRNGS:
        if jax.eval_shape(lambda n=name: jax.random.key(0, impl=n)).dtype == key_dtype:
            return name
    raise RunDirError(f"PRNG of {key_dtype} is unknown; known: {', '.join(_PRNGS)}")


def save_arrays(path: Path, tree: Any) -> None:
    """Write a dict or other pytree of arrays to an .npz; same arrays, same bytes.

    It is atomic and uncompressed; the names in the file are those of `flatten`.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in flatten(tree).items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, allow_pickle=False)
            # ZipInfo's default date is fixed: the file depends on the arrays alone.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue())
    write_atomic(Path(path), buffer.getvalue())


def load_arrays(
    path: Path, spec: Mapping[str, ArraySpec] | None = None
) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz; nothing in it is ever executed.

    Args:
      path: the file.
      spec: the arrays that must be there, and no others; None takes what there is.

    Raises:
      RunDirError: if the file is unreadable, pickled, or not as `spec` says.
    """
    try:
        # Opened here: of a broken file numpy would leave it open.
        with (
            Path(path).open("rb") as file,
            np.load(file, allow_pickle=False) as archive,
        ):
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # numpy and zipfile raise a dozen kinds on bad bytes
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise RunDirError(f"{path}: not a readable .npz file ({reason})") from None
    lengths: dict[str, int] = {}
    try:
        if spec is not None:
            _check_names(arrays, spec)
        for name, wanted in (spec or {}).items():
            shape = _resolve_shape(wanted.shape, arrays[name].shape, lengths)
            _check_array(name, arrays[name], shape, wanted.dtype)
            if wanted.finite and not np.isfinite(arrays[name]).all():
                raise RunDirError(f"{name} must be finite, has NaN or infinite entries")
    except RunDirError as error:
        raise RunDirError(f"{path}: {error}") from None
    return arrays


def _resolve_shape(
    wanted: tuple[int | str | None, ...], got: tuple[int, ...], lengths: dict[str, int]
) -> tuple:
    if len(wanted) != len(got):
        return wanted
    return tuple(
        length
        if want is None
        else lengths.setdefault(want, length)
        if isinstance(want, str)
        else want
        for want, length in zip(wanted, got, strict=True)
    )


def _check_array(name: str, array: np.ndarray, shape: tuple, dtype: str) -> None:
    if array.shape != tuple(shape) or str(array.dtype) != dtype:
        wanted = f"{dtype}[{', '.join(map(str, shape))}]"
        got = f"{array.dtype}[{', '.join(map(str, array.shape))}]"
        raise RunDirError(f"{name} must be {wanted}, got {got}")


def _check_names(got: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    for problem, names in (
        ("is missing", [name for name in wanted if name not in got]),
        ("is unknown", [name for name in got if name not in wanted]),
    ):
        if names:
            allowed = ", ".join(wanted)
            raise RunDirError(f"array {names[0]} {problem}; expected: {allowed}")


def require_no_link(file: Path) -> None:
    """Refuse to write through a link, which may lead anywhere."""
    if file.is_symlink():
        raise RunDirError(f"{file} is a link: it is not written through")


def lock_directory(path: Path) -> tuple[int, bool]:
    """Take the lock of a directory, made if need be; the kernel frees it on a kill.

    Returns:
      A file descriptor that holds the lock until it is closed; and whether it does,
      which some file systems and Windows do not offer.

    Raises:
      RunDirError: another process holds it, it is a link, or the directory cannot be
        written.
    """
    require_no_link(path / "lock")
    try:
        path.mkdir(parents=True, exist_ok=True)
        handle = os.open(path / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise RunDirError(f"{path} cannot be written: {error.strerror}") from None
    try:
        is_locked = _lock(handle)
        os.ftruncate(handle, 0)
        os.write(handle, f"pid {os.getpid()} on {socket.gethostname()}".encode())
    except OSError as error:
        holder = os.read(handle, 200).decode(errors="replace")
        os.close(handle)
        if isinstance(error, BlockingIOError):
            raise RunDirError(f"{path} is in use by {holder or 'a process'}") from None
        raise RunDirError(f"{path} cannot be locked: {error.strerror}") from None
    return handle, is_locked


def _lock(handle: int) -> bool:
    """Whether there was a lock to take; an error if another process holds it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):
            return False
        raise
    return True
