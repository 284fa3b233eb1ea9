"""What a run says about itself, as data: configuration, facts, metrics.

A config is written as plain dicts, lists, numbers and strings, and read back exactly.
JSON knows no non-finite numbers: they are the strings "NaN", "Infinity" and
"-Infinity", and come back as numbers.
"""

import contextlib
import dataclasses
import datetime
import difflib
import hashlib
import importlib.metadata
import json
import numbers
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import jax
import numpy as np

from autocost_jax.config import SearchConfig
from autocost_jax.config.checks import help_texts
from autocost_jax.files import RunDirError

C = TypeVar("C")
FORMAT = "autocost_jax run 1"
CONFIG, METRICS = "config.yaml", "metrics.jsonl"
_PACKAGES = (
    "autocost-jax",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "flax",
    "optax",
    "chex",
    "orbax-checkpoint",
    "numpy",
)
# Fields that say how a run is computed, not what: on resume they may be others.
MAY_DIFFER = frozenset({"population_chunk"})
_NON_FINITE = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}


def to_dict(config: Any) -> dict[str, Any]:
    """A nested config dataclass as plain dicts, lists, numbers and strings."""
    hints = get_type_hints(type(config))
    return {
        field.name: _encode(getattr(config, field.name), hints[field.name], field.name)
        for field in dataclasses.fields(config)
    }


def from_dict(cls: type[C], data: Any, name: str = "") -> C:
    """The inverse of `to_dict`; every field must be there.

    Args:
      cls: the dataclass.
      data: what `to_dict` returned, or YAML made of it.
      name: path of this part of the config, for messages.

    Raises:
      ValueError: unknown or missing field, or a value that is not allowed; the
        message names the field and what is valid.
    """
    where = name or cls.__name__
    if not isinstance(data, Mapping):
        raise ValueError(f"{where} must be a mapping of fields, got {data!r}")
    names = [field.name for field in dataclasses.fields(cls)]  # pyright: ignore
    allowed = f"fields of {where}: {', '.join(names)}"
    for problem, odd in (
        ("unknown", [key for key in data if key not in names]),
        ("missing", [key for key in names if key not in data]),
    ):
        if odd:
            raise ValueError(f"{problem} field {_join(name, odd[0])}; {allowed}")
    hints = get_type_hints(cls)
    values = {key: _decode(data[key], hints[key], _join(name, key)) for key in names}
    return cls(**values)


def replace_fields(config: C, values: Mapping[str, Any]) -> C:
    """A config with other values of some fields, those of nested configs included.

    No two fields of a config have the same name, so that none needs its path; they may
    stand below the names of their configs all the same, as in YAML.

    Args:
      config: a nested config dataclass; it is not changed.
      values: name -> value as `to_dict` has it, or name of a config -> mapping.

    Raises:
      ValueError: no such field, with the names that are nearest; or a value that is
        not allowed.
    """
    data = to_dict(config)
    _put(_holders(data), values)
    return from_dict(type(config), data)


def read_settings(file: str | Path) -> dict[str, Any]:
    """The mapping of a YAML file, for `replace_fields`.

    Raises:
      ValueError: it is not YAML, or not a mapping.
      OSError: it cannot be read.
    """
    import yaml

    try:
        settings = yaml.safe_load(Path(file).read_text())
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{file} is not YAML: {error}") from None
    if not isinstance(settings, dict):
        raise ValueError(f"{file} must be a mapping of settings, got {settings!r}")
    return settings


def settings_text(config: Any) -> str:
    """All settings of a config as YAML for `read_settings`, and what each is for."""
    import yaml

    texts = help_texts(type(config))
    text = yaml.safe_dump(to_dict(config), sort_keys=False, default_flow_style=None)
    lines = []
    for line in text.splitlines():
        name = line.split(":")[0].strip()
        lines.append(f"{line:<40} # {texts[name]}" if name in texts else line)
    return "\n".join(lines) + "\n"


def config_hash(config: Any) -> str:
    """The sha256 of a config's canonical JSON; equal configs, equal hash."""
    text = json.dumps(to_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def first_difference(old: Any, new: Any) -> tuple[str, Any, Any] | None:
    """Name and both values of the first field in which two configs differ.

    `MAY_DIFFER` names the fields that are not looked at.
    """
    return _difference(to_dict(old), to_dict(new), "")


def run_facts(seed: int | None = None) -> dict[str, Any]:
    """What to know about a run besides its config: versions, device, commit, time."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    devices = jax.devices()
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {
        "seed": seed,
        "created": now,
        "device": devices[0].device_kind,
        "num_devices": len(devices),
        "commit": _commit(),
        "versions": versions,
    }


def changed_facts(old: dict[str, Any], new: dict[str, Any]) -> str:
    """What differs in versions and devices between two `run_facts`, as one line."""
    before, after = (
        {name: facts.get(name) for name in ("device", "num_devices")}
        | facts.get("versions", {})
        for facts in (old, new)
    )
    return ", ".join(
        f"{name} {before.get(name)} -> {after.get(name)}"
        for name in {**before, **after}
        if before.get(name) != after.get(name)
    )


def read_config(path: str | Path, cls: type[C] = SearchConfig) -> tuple[C, dict]:
    """The configuration and the facts of a run directory.

    Raises:
      RunDirError: the directory is missing, not a run, or not readable.
    """
    document = read_document(Path(path))
    try:
        return from_dict(cls, document.get("config")), document["facts"]
    except ValueError as error:
        raise RunDirError(f"{Path(path) / CONFIG}: {error}") from None


def read_document(path: Path) -> dict[str, Any]:
    """The content of config.yaml; raises RunDirError if it is not a run's."""
    import yaml

    file = path / CONFIG
    try:
        document = yaml.safe_load(file.read_text())
    except FileNotFoundError:
        raise RunDirError(f"{path} is not a run directory: no {CONFIG}") from None
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RunDirError(f"{file} is not readable: {reason}") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise RunDirError(f"{file} was not written by this package as {FORMAT!r}")
    if not isinstance(document.setdefault("facts", {}), dict):
        raise RunDirError(f"the facts of {file} are not a mapping")
    return document


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """The rows of a run's metrics.jsonl; a torn last line is left out.

    Raises:
      RunDirError: a line other than the last is not a JSON object.
    """
    file = Path(path) / METRICS
    lines = file.read_bytes().split(b"\n") if file.exists() else [b""]
    rows = []
    for number, line in enumerate(lines[:-1], start=1):
        try:
            row = _from_json(json.loads(line))
        except ValueError:
            row = None
        if isinstance(row, dict):
            rows.append(row)
        elif number < len(lines) - 1:
            raise RunDirError(f"{file}: line {number} is not a JSON object")
    return rows


def list_stages(path: str | Path) -> dict[int, Path]:
    """The stage files of a run by stage, in order."""
    files = Path(path).glob("stage_*.npz")
    numbered = [(file.stem.removeprefix("stage_"), file) for file in files]
    return dict(sorted((int(key), file) for key, file in numbered if key.isdecimal()))


def to_json(value: Any) -> Any:
    """Strict JSON: arrays as lists, non-finite numbers as strings."""
    if isinstance(value, Mapping):
        return {str(key): to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return to_json(np.asarray(value).tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return "NaN" if np.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


def _holders(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The dict, out of nested ones, that holds each field."""
    holders = dict.fromkeys(data, data)
    for value in data.values():
        holders |= _holders(value) if isinstance(value, dict) else {}
    return holders


def _put(holders: dict[str, dict[str, Any]], values: Mapping[str, Any]) -> None:
    """Write values into the dicts that hold their fields."""
    for name, value in values.items():
        if name in holders and isinstance(value, Mapping):
            _put(holders, value)
        elif name in holders:
            holders[name][name] = value
        else:
            near = difflib.get_close_matches(str(name), holders, 3, 0.4)
            raise ValueError(
                f"unknown setting {name!r}"
                f"{'; the nearest: ' + ', '.join(near) if near else ''}"
                "; `autocost info --preset NAME` lists all"
            )


def _difference(old: dict, new: dict, name: str) -> tuple[str, Any, Any] | None:
    for key in [*old, *(key for key in new if key not in old)]:
        a, b = old.get(key), new.get(key)
        if key in MAY_DIFFER:
            continue
        a, b = _by_place(a), _by_place(b)
        if isinstance(a, dict) and isinstance(b, dict):
            found = _difference(a, b, _join(name, key))
            if found is not None:
                return found
        elif repr(a) != repr(b):  # by text: NaN is equal to itself, 1 is not 1.0
            return _join(name, key), a, b
    return None


def _by_place(value: Any) -> Any:
    """A list of dicts, such as a table's methods, as a dict."""
    is_table = isinstance(value, list) and value and isinstance(value[0], dict)
    return {f"[{i}]": row for i, row in enumerate(value)} if is_table else value


def _join(name: str, key: Any) -> str:
    return f"{name}.{key}".replace(".[", "[") if name else str(key)


def _encode(value: Any, hint: Any, name: str) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if isinstance(value, tuple):
        hint = next((kind for kind in kinds if get_origin(kind) is tuple), tuple)
        hints = _entry_hints(get_args(hint) or (Any, ...), value)
        return [_encode(v, h, name) for v, h in zip(value, hints, strict=True)]
    if value is None or isinstance(value, bool | str):
        return value
    # 1 in a field of floats is stored as 1.0: they are the same config.
    if isinstance(value, numbers.Integral) and (float not in kinds or int in kinds):
        return int(value)
    if isinstance(value, numbers.Real):  # NumPy's numbers among them
        return float(value)
    raise ValueError(f"{name}: a {type(value).__name__} cannot be stored in a config")


def _decode(value: Any, hint: Any, name: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return from_dict(hint, value, name)  # pyright: ignore[reportArgumentType]
    if origin in (Union, UnionType):
        if value is None and NoneType in args:
            return None
        return _decode_union(value, [a for a in args if a is not NoneType], name)
    if origin is tuple:
        return _decode_tuple(value, args, name)
    if origin is Literal:
        if value in args:
            return value
        raise ValueError(
            f"{name} must be one of {', '.join(map(str, args))}, got {value!r}"
        )
    if hint is float and isinstance(value, str):
        value = _number(value)  # YAML takes 4e-4 for a text
    is_number = isinstance(value, int) and not isinstance(value, bool)
    if hint is float and (is_number or isinstance(value, float)):
        return float(value)
    if (hint is int and is_number) or (hint in (bool, str) and type(value) is hint):
        return value
    raise ValueError(f"{name} must be a {hint.__name__}, got {value!r}")


def _decode_union(value: Any, options: list[Any], name: str) -> Any:
    options = sorted(options, key=lambda option: option is not type(value))
    for option in options[:-1]:
        with contextlib.suppress(ValueError):
            return _decode(value, option, name)
    return _decode(value, options[-1], name)


def _decode_tuple(value: Any, args: tuple, name: str) -> tuple:
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list, got {value!r}")
    hints = _entry_hints(args, value)
    if len(hints) != len(value):
        raise ValueError(f"{name} must have {len(hints)} entries, got {value!r}")
    return tuple(_decode(v, h, name) for v, h in zip(value, hints, strict=True))


def _entry_hints(args: tuple, value: list | tuple) -> tuple:
    return (args[0],) * len(value) if args[-1] is ... else args


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _from_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _from_json(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_from_json(entry) for entry in value]
    return _NON_FINITE.get(value, value) if isinstance(value, str) else value


def _commit() -> str | None:
    """Commit of the repository the user stands in, "-dirty" if it was changed."""
    # A repository may name a program that watches its files: it is not to be trusted.
    command = ["git", "-c", "core.fsmonitor=false", "describe", "--always", "--dirty"]
    command += ["--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
