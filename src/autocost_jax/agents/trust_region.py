"""Second-order pieces: a linearised policy, conjugate gradient, backtracking.

Everything stays finite for every lane of a `vmap`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Product = Callable[[jax.Array], jax.Array]
Distribution = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
_SOLVED = 1e-20  # squared residual of a unit right-hand side that counts as zero


class Linearised(NamedTuple):
    """A policy's (mean, log_std) to first order around its parameters.

    Attributes:
      mean: [R, U] at the parameters.
      log_std: [U] at the parameters.
      jvp: [n] -> ([R, U], [U]), the derivative along a direction.
      vjp: ([R, U], [U]) -> [n], its transpose.
    """

    mean: jax.Array
    log_std: jax.Array
    jvp: Callable[[jax.Array], tuple[jax.Array, jax.Array]]
    vjp: Callable[[tuple[jax.Array, jax.Array]], jax.Array]


def linearise(distribution: Distribution, theta: jax.Array) -> Linearised:
    """The policy's outputs and their derivative both ways, traced once.

    Args:
      distribution: theta -> (mean [R, U], log_std [U]) on a fixed batch.
      theta: [n] flat policy parameters.

    Returns:
      See `Linearised`.
    """
    (mean, log_std), jvp = jax.linearize(distribution, theta)
    transpose = jax.linear_transpose(jvp, theta)
    return Linearised(mean, log_std, jvp, lambda cotangent: transpose(cotangent)[0])


def dot(x: jax.Array, y: jax.Array) -> jax.Array:
    """Inner products [K] of the rows of x and y, [K, n]."""
    return jnp.sum(x * y, axis=-1)


def conjugate_gradient(
    product: Product, rhs: jax.Array, num_iterations: int
) -> jax.Array:
    """Approximate H^-1 rhs, K independent recurrences that share each product.

    Every residual is made orthogonal to all before it, which it is but for rounding:
    without that ten iterations in float32 can end several percent of the solution away
    from those in float64. A lane whose residual has vanished, or that meets a direction
    of no positive curvature, keeps what it has.

    Args:
      product: [K, n] -> [K, n], multiplication by a positive definite H.
      rhs: [K, n] of unit norm (or zero).
      num_iterations: fixed count.

    Returns:
      [K, n].

    Source: Hestenes & Stiefel 1952, with guards; reorthogonalised as Lanczos vectors
    are (Golub & Van Loan, Matrix Computations, section 10.3).
    """

    def iterate(index: int, carry: tuple[jax.Array, ...]) -> Any:
        x, residual, direction, rho, basis = carry
        image = product(direction)
        curvature = dot(direction, image)
        ok = (rho > _SOLVED) & (curvature > 0)
        alpha = jnp.where(ok, rho / jnp.where(ok, curvature, 1.0), 0.0)[:, None]
        x = x + alpha * direction
        scale = jnp.where(ok, jax.lax.rsqrt(jnp.where(ok, rho, 1.0)), 0.0)[:, None]
        basis = basis.at[index].set(scale * residual)
        residual = residual - alpha * image
        residual = residual - jnp.einsum(
            "ikn,ik->kn", basis, jnp.einsum("ikn,kn->ik", basis, residual)
        )
        rho_new = dot(residual, residual)
        beta = jnp.where(ok, rho_new / jnp.where(ok, rho, 1.0), 0.0)[:, None]
        direction = jnp.where(ok[:, None], residual + beta * direction, direction)
        return x, residual, direction, jnp.where(ok, rho_new, rho), basis

    basis = jnp.zeros((num_iterations, *rhs.shape), rhs.dtype)
    start = (jnp.zeros_like(rhs), rhs, rhs, dot(rhs, rhs), basis)
    return jax.lax.fori_loop(0, num_iterations, iterate, start)[0]


def backtrack(
    evaluate: Callable[[jax.Array], tuple[jax.Array, Any]],
    theta: jax.Array,
    step: jax.Array,
    ratio: float,
    num_steps: int,
) -> tuple[jax.Array, jax.Array, jax.Array, Any]:
    """The largest acceptable step theta + ratio^j step, j = 0 ... num_steps - 1.

    Args:
      evaluate: parameters [n] -> (acceptable [] bool, a pytree of arrays). A NaN
        must compare as not acceptable.
      theta: [n] the old parameters.
      step: [n] the full step.
      ratio: shrink factor, in (0, 1).
      num_steps: number of candidates; those after the accepted one are not evaluated
        (under a `vmap`: after the last lane has accepted one).

    Returns:
      new parameters [n] (theta itself, bit for bit, if none is acceptable),
      accepted [] bool, fraction [] = ratio^j or 0, and the pytree of the accepted
      candidate (of the last candidate if none is acceptable).
    """
    fractions = ratio ** jnp.arange(num_steps, dtype=theta.dtype)

    def is_searching(carry: tuple[jax.Array, jax.Array, Any]) -> jax.Array:
        accepted, tried, _ = carry
        return ~accepted & (tried < num_steps)

    def attempt(carry: tuple[jax.Array, jax.Array, Any]) -> Any:
        _, tried, _ = carry
        accepted, info = evaluate(theta + fractions[tried] * step)
        return accepted, tried + 1, info

    shape = jax.eval_shape(evaluate, theta)[1]
    info = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    start = (jnp.zeros((), bool), jnp.zeros((), jnp.int32), info)
    accepted, tried, info = jax.lax.while_loop(is_searching, attempt, start)
    fraction = jnp.where(accepted, fractions[tried - 1], 0.0)
    new = jnp.where(accepted, theta + fraction * step, theta)
    return new, accepted, fraction, info
