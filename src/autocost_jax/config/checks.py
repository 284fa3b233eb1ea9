"""Settings that know what is allowed and what they are for.

A field made by `setting` carries both as metadata: `check_fields` holds a configuration
to the checks, command lines and `autocost info` show the help.
"""

import dataclasses
import numbers
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

LEAST, MOST = 2.0**-126, (2 - 2.0**-23) * 2.0**127  # float32's, apart from 0


class Check(NamedTuple):
    """What a value may be.

    Attributes:
      allowed: in words, after "must be".
      holds: value -> whether it is.
    """

    allowed: str
    holds: Callable[[Any], bool]


def is_finite(value: Any) -> bool:
    """Whether a value is a number that is finite, and not lost, in float32."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    size: Any = abs(value)
    return bool(size == 0 or LEAST <= size <= MOST)


def is_integer(value: Any, bound: int = 2**31) -> bool:
    """Whether a value is an integer, which a bool is not, of a size below a bound."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        return False
    size: Any = abs(value)
    return bool(size < bound)


def is_tuple_of(holds: Callable[[Any], bool], value: Any) -> bool:
    """Whether a value is a tuple (a list cannot be hashed) of what is allowed."""
    return isinstance(value, tuple) and all(map(holds, value))


FINITE = Check("a number that float32 can hold", is_finite)
POSITIVE = Check(
    "> 0 and a number that float32 can hold", lambda x: is_finite(x) and x > 0
)
POSITIVE_OR_NONE = Check(
    f"null, or {POSITIVE.allowed}", lambda x: x is None or POSITIVE.holds(x)
)
NOT_NEGATIVE = Check(
    ">= 0 and a number that float32 can hold", lambda x: is_finite(x) and x >= 0
)
COUNT = Check("an integer in [1, 2**31)", lambda x: is_integer(x) and x >= 1)
NUMBER = Check("an integer in [0, 2**31)", lambda x: is_integer(x) and x >= 0)
OBJECTS = Check("an integer in [0, 1000]", lambda x: is_integer(x, 1001) and x >= 0)
SWITCH = Check("true or false", lambda x: isinstance(x, bool))
DISCOUNT = Check("in (0, 1]", lambda x: is_finite(x) and 0 < x <= 1)
SHARE = Check("in [0, 1]", lambda x: is_finite(x) and 0 <= x <= 1)
RATIO = Check("in (0, 1)", lambda x: is_finite(x) and 0 < x < 1)
SEED = Check("an integer in [0, 2**32)", lambda x: is_integer(x, 2**32) and x >= 0)
COUNTS = Check(
    "a tuple of integers in [1, 2**31)", lambda x: is_tuple_of(COUNT.holds, x)
)
CORNERS = Check(
    "(xmin, ymin, xmax, ymax), numbers that float32 can hold",
    lambda x: is_tuple_of(is_finite, x) and len(x) == 4,
)


def is_distinct(values: tuple[Any, ...]) -> bool:
    """Whether no value is there twice."""
    return len(set(values)) == len(values)


def one_of(kind: Any) -> Check:
    """One of the strings of a `Literal`."""
    known = get_args(kind)
    return Check(f"one of {', '.join(known)}", lambda x: type(x) is str and x in known)


def some_of(kind: Any) -> Check:
    """A tuple of distinct strings of a `Literal`, at least one."""
    known = get_args(kind)
    return Check(
        f"distinct names out of {', '.join(known)}",
        lambda x: is_tuple_of(known.__contains__, x) and x != () and is_distinct(x),
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
    """Hold every field to its check, or its class; a `ValueError` says what it is."""
    for field in dataclasses.fields(config):
        check, value = field.metadata.get("check"), getattr(config, field.name)
        if isinstance(field.type, type) and dataclasses.is_dataclass(field.type):
            kind = field.type
            require(isinstance(value, kind), field.name, f"of {kind.__name__}", value)
        elif check is not None:
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
