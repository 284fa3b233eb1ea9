"""What the command lines share: flags from dataclasses, devices, one-line errors."""

import contextlib
import dataclasses
import io
import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from autocost_jax.config import TrainConfig, env_config

T = TypeVar("T")
BAD_INPUT = 2


def parse(kind: type[T], argv: Sequence[str], prog: str, **options: Any) -> T:
    """Flags of a dataclass; a bad one ends the program in one line, status 2."""
    import tyro

    panel = io.StringIO()
    try:
        with contextlib.redirect_stderr(panel):
            return tyro.cli(kind, args=list(argv), prog=prog, **options)
    except SystemExit as stop:
        if stop.code not in (0, None):
            fail(f"{prog}: {_first_sentence(panel.getvalue())} (see {prog} --help)")
        sys.stderr.write(panel.getvalue())
        raise


def _first_sentence(panel: str) -> str:
    """The message of tyro's error panel without its frame, on one line."""
    lines = [re.sub(r"[│╭╮╰╯─]+", " ", line).strip() for line in panel.splitlines()]
    text = " ".join(line for line in lines if line)
    text = re.sub(r"^(Parsing error|Value error|Error parsing \S+:)\s+", "", text)
    text = re.sub(r"^Error parsing (search|train):\s+", "", text)
    advice = r"\s+(?:Argument helptext|For full helptext|Arguments similar)"
    return re.split(advice, text)[0]


def flag(argv: Sequence[str], name: str) -> str | None:
    """The value of a flag, before the flags are parsed; the last one wins, as there."""
    value = None
    for index, word in enumerate(argv):
        if word == name and index + 1 < len(argv):
            value = argv[index + 1]
        elif word.startswith(f"{name}="):
            value = word.partition("=")[2]
    return value


def switch(argv: Sequence[str], name: str) -> bool:
    """Whether a switch is on, before the flags are parsed; --no-NAME turns it off."""
    words = {name: True, name.replace("--", "--no-", 1): False}
    given = [words[word] for word in map(_hyphens, argv) if word in words]
    return given[-1] if given else False


def _hyphens(word: str) -> str:
    return word.replace("_", "-")


def with_env(train: TrainConfig, argv: Sequence[str]) -> TrainConfig:
    """The training configuration in the world that `--env` names, if it is given.

    Flags of single settings come on top of it; only the episode's length is the
    preset's, and the physics where the world has them.

    Raises:
      ValueError: if there is no such world; the message lists those that exist.
    """
    name = flag(argv, "--env")
    if name is None:
        return train
    env = dataclasses.replace(env_config(name), num_steps=train.env.num_steps)
    if env.has_closed_form:
        env = dataclasses.replace(env, physics=train.env.physics)
    return dataclasses.replace(train, env=env)


def fail(message: str, status: int = BAD_INPUT) -> None:
    """End the program with one line on stderr."""
    from autocost_jax.runs.cluster import leave

    sys.stderr.write(" ".join(message.split()) + "\n")
    leave(status)
    raise SystemExit(status)


def guarded(main: Callable[[], None], prog: str) -> None:
    """Run a command; expected errors become one line and an exit status.

    Bad input is status 2, a run that could not go on is 1, Ctrl-C is 130.
    """
    from autocost_jax.files import DiskFullError
    from autocost_jax.runs.cluster import is_lost_peer

    try:
        main()
    except ValueError as error:
        fail(f"{prog}: {error}", status=1 if is_lost_peer(error) else BAD_INPUT)
    except OSError as error:
        fail(f"{prog}: {error.strerror or error}: {error.filename or ''}")
    except (DiskFullError, RuntimeError) as error:
        fail(f"{prog}: {error}", status=1)
    except KeyboardInterrupt:
        fail(f"{prog}: interrupted; a run goes on with --resume", status=130)


def quiet() -> None:
    """Keep start-up chatter of libraries (optional parts not installed) away."""
    logging.getLogger("absl").setLevel(logging.ERROR)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")


def use_compile_cache(is_wanted: bool) -> Path | None:
    """Keep compiled programs between runs, so that a second start takes seconds.

    They go to `autocost_jax` in the user's cache directory ($XDG_CACHE_HOME, by default
    ~/.cache), or wherever $JAX_COMPILATION_CACHE_DIR says. JAX knows a program by its
    code, shapes, versions and devices, so an entry is never wrong, only unused.

    Args:
      is_wanted: False leaves JAX as it is.

    Returns:
      The directory; None if not wanted, or if it cannot be written to.
    """
    import jax

    if not is_wanted:
        return None
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    default = Path(base) / "autocost_jax"
    path = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or default)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    return path


def use_devices(
    count: int | None,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> Sequence[Any]:
    """The devices a run uses; on a CPU one for each core unless told otherwise.

    Must be called before anything of JAX has run: a CPU is split into devices then.

    Args:
      count: number of devices, None for all.
      coordinator: see `cluster.join`, as the next two.
      num_processes: of the run.
      process_id: of this process.

    Raises:
      ValueError: if there are fewer, or if the processes are not well described.
    """
    import jax

    from autocost_jax.runs import cluster

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    with contextlib.suppress(RuntimeError):  # too late to split: take what is there
        jax.config.update("jax_num_cpu_devices", cores)
    cluster.join(coordinator, num_processes, process_id)
    devices = jax.devices()
    if coordinator is not None and count is not None:
        raise ValueError("devices cannot be chosen in a run of several processes")
    if count is not None and not 1 <= count <= len(devices):
        raise ValueError(f"devices must be in [1, {len(devices)}], got {count}")
    return devices[:count]
