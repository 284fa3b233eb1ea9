"""The precision of matrix products, where JAX would choose a lower one."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")


def full_precision(fn: Callable[P, T]) -> Callable[P, T]:
    """`fn` with matrix products in the precision of their operands.

    Left alone, JAX lets a GPU round the operands of float32 products to tensorfloat32,
    11 bits: too coarse for physics, and another policy than the one that learns.
    """

    @functools.wraps(fn)
    def exact(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return fn(*args, **kwargs)

    return exact
