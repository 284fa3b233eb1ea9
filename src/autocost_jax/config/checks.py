"""Checks of configurations: each raises one line that says what is allowed."""

import math
import numbers
from typing import Any


def require(ok: bool, name: str, allowed: str, got: Any) -> None:
    """Raise a `ValueError` that names what was wrong and what is allowed."""
    if not ok:
        raise ValueError(f"{name} must be {allowed}, got {got!r}")


def is_finite(value: Any) -> bool:
    """Whether a value is a finite real number."""
    return isinstance(value, numbers.Real) and math.isfinite(value)


def require_finite(config: Any, *names: str) -> None:
    """Named fields must be finite."""
    for name in names:
        value = getattr(config, name)
        require(is_finite(value), name, "finite", value)


def require_positive(config: Any, *names: str) -> None:
    """Named fields must be finite and above zero."""
    for name in names:
        value = getattr(config, name)
        require(is_finite(value) and value > 0, name, "finite and > 0", value)


def is_integer(value: Any) -> bool:
    """Whether a value is an integer, which a bool is not."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def require_counts(config: Any, *names: str) -> None:
    """Named fields must be integers of at least 1."""
    for name in names:
        value = getattr(config, name)
        require(is_integer(value) and value >= 1, name, "an integer >= 1", value)
