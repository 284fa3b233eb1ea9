"""What the command lines share: flags from dataclasses, devices, one-line errors."""

import contextlib
import dataclasses
import io
import logging
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from autocost_jax.config import EnvConfig, SearchConfig, TrainConfig, env_config
from autocost_jax.config.checks import all_fields

T = TypeVar("T")
C = TypeVar("C", SearchConfig, TrainConfig)
BAD_INPUT = 2
NEEDED = {  # of JAX's settings
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_disable_jit": False,
    "jax_enable_x64": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
}


def parse(kind: type[T], argv: Sequence[str], prog: str, **options: Any) -> T:
    """Flags of a dataclass; a bad one ends the program in one line, status 2."""
    import tyro

    panel = io.StringIO()
    try:
        with contextlib.redirect_stderr(panel):
            none = tyro.conf.DisallowNone  # nothing given is not a value
            return tyro.cli(kind, args=list(argv), prog=prog, config=(none,), **options)
    except SystemExit as stop:
        if stop.code not in (0, None):
            fail(f"{prog}: {_message(panel.getvalue())} (see {prog} --help)")
        sys.stderr.write(panel.getvalue())
        raise


def _message(panel: str) -> str:
    """The message of tyro's error panel without its title, frame and advice."""
    lines = [line.strip("│ ") for line in panel.splitlines()]
    lines = [line for line in lines if line.strip("╭╮╰╯─- ")]
    text = " ".join(lines[1:])
    for advice in ("Argument helptext", "For full helptext", "Arguments similar"):
        text = text.partition(advice)[0]
    return text.strip()


def with_flags(options: type, config: type, names: Sequence[str]) -> Any:
    """A dataclass of options, with a flag for each named setting of a configuration.

    These flags are None where they are not given; their types and help texts are the
    fields'.
    """
    import tyro

    known = all_fields(config)
    flags = [(name, known[name].type, known[name].metadata["help"]) for name in names]
    fields: list[Any] = [
        (name, Annotated[kind | None, tyro.conf.arg(help=text)], None)
        for name, kind, text in flags
    ]
    doc = {"__doc__": options.__doc__}
    return dataclasses.make_dataclass(
        options.__name__, fields, bases=(options,), namespace=doc, frozen=True
    )


def config_with(
    config: C, env: str | None, flags: Mapping[str, Any], settings: Sequence[str]
) -> C:
    """The configuration that a command line asks for.

    Args:
      config: a `SearchConfig` or `TrainConfig`: a preset's or a run's.
      env: its world, if another one. Of the former only the episode's length stays, and
        the physics where the new world has them.
      flags: name -> value; those that are None were not given.
      settings: "name=value" of any field, values as in YAML. They come last.

    Raises:
      ValueError: no such world or setting, or a value that is not allowed.
    """
    import yaml

    from autocost_jax.runs.config_files import replace_fields, to_dict

    given = {name: value for name, value in flags.items() if value is not None}
    for word in settings:
        name, mark, text = word.partition("=")
        if not mark:
            raise ValueError(f"set must be name=value, got {word!r}")
        try:
            given[name.replace("-", "_")] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f"set: the value of {word!r} is not YAML") from None
    if env is not None:
        train = config if isinstance(config, TrainConfig) else config.train
        given = {"env": to_dict(_world(env, train.env)), **given}
    return replace_fields(config, given)


def _world(name: str, former: EnvConfig) -> EnvConfig:
    env = dataclasses.replace(env_config(name), num_steps=former.num_steps)
    if env.has_closed_form:
        env = dataclasses.replace(env, physics=former.physics)
    return env


def fail(message: str, status: int = BAD_INPUT) -> None:
    """End the program with one line on stderr."""
    from autocost_jax.runs.cluster import leave

    with contextlib.suppress(OSError):  # a closed terminal
        sys.stderr.write(" ".join(map(str.strip, message.splitlines())) + "\n")
    leave(status)
    raise SystemExit(status)


def guarded(main: Callable[[], None], prog: str) -> None:
    """Run a command; expected errors become one line and an exit status.

    Bad input is status 2, a run that could not go on is 1, a signal N is 128 + N: 130
    for Ctrl-C, 143 for SIGTERM, 129 for SIGHUP.
    """
    from autocost_jax.files import DiskFullError
    from autocost_jax.runs.cluster import is_lost_peer
    from autocost_jax.runs.stopping import Stopped

    settle_jax(prog)
    try:
        _with_devices(main)
    except ValueError as error:
        fail(f"{prog}: {error}", status=1 if is_lost_peer(error) else BAD_INPUT)
    except OSError as error:
        fail(f"{prog}: {error.strerror or error}: {error.filename or ''}")
    except (DiskFullError, RuntimeError) as error:
        fail(f"{prog}: {error}", status=1)
    except Stopped as stop:
        words = f"stopped after a checkpoint; go on with: {prog} --resume --out"
        path = shlex.quote(str(stop.path))
        fail(f"{prog}: {words} {path}", status=128 + stop.signum)
    except KeyboardInterrupt:
        fail(f"{prog}: interrupted; a run goes on with --resume", status=130)


def settle_jax(prog: str) -> None:
    """Take back what the environment has set of JAX and would break a command.

    NaN and infinity are values here: a slot that meets one is frozen and counted.
    """
    import jax

    changed = [
        name for name, value in NEEDED.items() if getattr(jax.config, name) != value
    ]
    for name in changed:
        jax.config.update(name, NEEDED[name])
    if changed:
        names = ", ".join(changed)
        sys.stderr.write(f"{prog}: set back to what commands need: {names}\n")


def _with_devices(main: Callable[[], None]) -> None:
    """Run a command; JAX's bare AssertionError where it has no device gets words."""
    try:
        main()
    except AssertionError:
        import jax

        try:
            jax.devices()
        except AssertionError:
            platforms = os.environ.get("JAX_PLATFORMS")
            raise ValueError(
                f"JAX finds no device: JAX_PLATFORMS={platforms} names none that is "
                "there and that JAX is installed for"
            ) from None
        raise


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
      The directory; None if not wanted, or if there is none that can be written to.
    """
    import jax

    if not is_wanted:
        return None
    try:
        path = _cache_directory()
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # the latter: a user without a home
        return None
    if not os.access(path, os.W_OK):
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    return path


def _cache_directory() -> Path:
    if path := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(path)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "autocost_jax"


def _has_split_cpu() -> bool:
    """Whether the user has said into how many devices JAX splits a CPU."""
    flags = os.environ.get("XLA_FLAGS", "")
    is_flag = "--xla_force_host_platform_device_count" in flags
    return is_flag or "JAX_NUM_CPU_DEVICES" in os.environ


def use_devices(
    count: int | None,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> Sequence[Any]:
    """The devices a run uses; on a CPU one for each core unless told otherwise.

    $JAX_NUM_CPU_DEVICES, or XLA's flag for it, says otherwise, too. Must be called
    before anything of JAX has run: a CPU is split into devices then.

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
    if not _has_split_cpu():
        with contextlib.suppress(RuntimeError):  # too late: take what is there
            jax.config.update("jax_num_cpu_devices", cores)
    cluster.join(coordinator, num_processes, process_id)
    devices = jax.devices()
    if coordinator is not None and count is not None:
        raise ValueError("devices cannot be chosen in a run of several processes")
    if count is not None and not 1 <= count <= len(devices):
        raise ValueError(f"devices must be in [1, {len(devices)}], got {count}")
    return devices[:count]
