"""Settings that know what is allowed and what they are for.

A field made by `setting` carries both as metadata: `check_fields` holds a configuration
to the checks, command lines and `autocost info` show the help.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import Any, NamedTuple, get_args


class Check(NamedTuple):
    """What a value may be.

    Attributes:
      allowed: in words, after "must be".
      holds: value -> whether it is.
    """

    allowed: str
    holds: Callable[[Any], bool]


def is_finite(value: Any) -> bool:
    """Whether a value is a finite real number."""
    return isinstance(value, numbers.Real) and math.isfinite(value)


def is_integer(value: Any) -> bool:
    """Whether a value is an integer, which a bool is not."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


FINITE = Check("finite", is_finite)
POSITIVE = Check("finite and > 0", lambda x: is_finite(x) and x > 0)
POSITIVE_OR_NONE = Check("finite and > 0", lambda x: x is None or POSITIVE.holds(x))
NOT_NEGATIVE = Check("finite and >= 0", lambda x: is_finite(x) and x >= 0)
COUNT = Check("an integer >= 1", lambda x: is_integer(x) and x >= 1)
NUMBER = Check("an integer >= 0", lambda x: is_integer(x) and x >= 0)
SWITCH = Check("true or false", lambda x: isinstance(x, bool))
DISCOUNT = Check("in (0, 1]", lambda x: is_finite(x) and 0 < x <= 1)
SHARE = Check("in [0, 1]", lambda x: is_finite(x) and 0 <= x <= 1)
RATIO = Check("in (0, 1)", lambda x: is_finite(x) and 0 < x < 1)
SEED = Check("an integer in [0, 2**32)", lambda x: is_integer(x) and 0 <= x < 2**32)
COUNTS = Check("a tuple of integers >= 1", lambda x: all(map(COUNT.holds, x)))


def one_of(kind: Any) -> Check:
    """One of the strings of a `Literal`."""
    known = get_args(kind)
    return Check(f"one of {', '.join(known)}", lambda x: x in known)


def some_of(kind: Any) -> Check:
    """A tuple of distinct strings of a `Literal`, at least one."""
    known = get_args(kind)
    return Check(
        f"distinct names out of {', '.join(known)}",
        lambda x: len(x) > 0 and len(set(x)) == len(x) and set(x) <= set(known),
    )


def setting(default: Any, check: Check | None, text: str) -> Any:
    """A field of a configuration.

    Args:
      default: its value where none is given.
      check: what it may be by itself; None where the class has a rule of its own.
      text: what it is for, in one line.
    """
    return dataclasses.field(default=default, metadata={"check": check, "help": text})


def require(ok: bool, name: str, allowed: str, got: Any) -> None:
    """Raise a `ValueError` that names what was wrong and what is allowed."""
    if not ok:
        raise ValueError(f"{name} must be {allowed}, got {got!r}")


def check_fields(config: Any) -> None:
    """Hold every field to its check; a `ValueError` says what is allowed."""
    for field in dataclasses.fields(config):
        check, value = field.metadata.get("check"), getattr(config, field.name)
        if check is not None:
            require(check.holds(value), field.name, check.allowed, value)


def all_fields(kind: Any) -> dict[str, dataclasses.Field[Any]]:
    """Every setting of a configuration class by its name, nested ones included."""
    found: dict[str, dataclasses.Field[Any]] = {}
    for field in dataclasses.fields(kind):
        is_nested = dataclasses.is_dataclass(field.type)
        found |= all_fields(field.type) if is_nested else {field.name: field}
    return found


def help_texts(kind: Any) -> dict[str, str]:
    """What each setting of a configuration class is for, nested ones included."""
    return {name: field.metadata["help"] for name, field in all_fields(kind).items()}
