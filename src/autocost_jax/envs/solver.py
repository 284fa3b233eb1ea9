"""MuJoCo's constraint solver for many small worlds at once.

The problem is MuJoCo's: over accelerations x of the nv degrees of freedom, minimise

    1/2 (x - a)' M (x - a) + 1/2 sum over rows i of D_i min(0, J_i x - r_i)^2

with mass matrix M, unconstrained acceleration a, and for each row of a contact's
pyramid or of a joint limit its Jacobian J_i, stiffness D_i and reference r_i. So is the
method, Newton with an exact line search. `mjx.solver.solve` does the same; this one
exists because that one factors every world's Hessian by a LAPACK call, which on a CPU
hangs where two of them meet in JAX's thread pool, and because it is a few times faster.

Source: MuJoCo documentation, Computation, "Primal problem"; engine_solver.c.
Differs: a fixed number of iterations; no rows but inequalities, no elliptic cones.
"""

from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

LINE_SEARCH_STEPS = 5


def solve_constraints(model: mjx.Model, data: mjx.Data, iterations: int) -> mjx.Data:
    """The acceleration under constraints, and the constraints' forces.

    Args:
      model: pyramidal cones, no equalities, no friction loss.
      data: `mjx.fwd_acceleration` has been called.
      iterations: Newton steps.

    Returns:
      data with `qacc` [nv], `qfrc_constraint` [nv] and `_impl.efc_force` [nefc].
    """
    impl: Any = data._impl
    jacobian, stiffness = impl.efc_J, impl.efc_D
    mass = mjx.full_m(model, data)

    def gap(x: jax.Array) -> jax.Array:
        return _mul(jacobian, x) - impl.efc_aref

    def cost(x: jax.Array) -> jax.Array:
        away = x - data.qacc_smooth
        short = jnp.minimum(0.0, gap(x))
        return (_mul(mass, away) * away).sum() + (stiffness * short * short).sum()

    def step(_, x: jax.Array) -> jax.Array:
        distance = gap(x)
        weight = jnp.where(distance < 0, stiffness, 0.0)
        gradient = _mul(mass, x) - data.qfrc_smooth
        gradient += _mul(jacobian.T, weight * distance)
        hessian = mass + jnp.dot(jacobian.T * weight, jacobian, precision="highest")
        direction = -solve_positive(hessian, gradient)
        change = _mul(jacobian, direction)
        slope = (gradient * direction).sum()
        slope -= (weight * distance * change).sum()  # of the mass term alone
        curvature = (_mul(mass, direction) * direction).sum()
        length = _line_search(slope, curvature, stiffness, distance, change)
        return x + length * direction

    start = jnp.where(
        cost(data.qacc_warmstart) < cost(data.qacc_smooth),
        data.qacc_warmstart,
        data.qacc_smooth,
    )
    qacc = jax.lax.fori_loop(0, iterations, step, start)
    force = -stiffness * jnp.minimum(0.0, gap(qacc))
    solved: Any = {
        "qacc": qacc,
        "qfrc_constraint": _mul(jacobian.T, force),
        "_impl.efc_force": force,
    }
    result: Any = data.tree_replace(solved)
    return result


def _mul(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """[n] matrix [n, m] times vector [m], elementwise: exact float32 everywhere."""
    return (matrix * vector).sum(-1)


def _line_search(
    slope: jax.Array,
    curvature: jax.Array,
    stiffness: jax.Array,
    distance: jax.Array,
    change: jax.Array,
) -> jax.Array:
    """Where a convex, piecewise quadratic function of one number is lowest.

        f'(t) = slope + curvature t + sum_i D_i change_i min(0, distance_i + t change_i)

    Newton's method on f', which is piecewise linear and increases; the bracket found so
    far takes the middle where a step would leave it.

    Returns:
      t [], at least 0.
    """

    def body(_, carry):
        t, low, high = carry
        short = jnp.minimum(0.0, distance + t * change)
        first = slope + curvature * t + (stiffness * change * short).sum()
        bent = jnp.where(short < 0, stiffness * change * change, 0.0).sum()
        low, high = jnp.where(first < 0, t, low), jnp.where(first < 0, high, t)
        newton = t - first / (curvature + bent)
        middle = jnp.where(jnp.isinf(high), 2 * t, (low + high) / 2)
        inside = (newton >= low) & (newton <= high)
        return jnp.where(inside, newton, middle), low, high

    one = jnp.ones_like(slope)
    start = (one, 0 * one, jnp.inf * one)
    t, _, _ = jax.lax.fori_loop(0, LINE_SEARCH_STEPS, body, start)
    return jnp.where(curvature > 0, t, 0.0)


def solve_positive(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """The solution x [n] of matrix [n, n] x = vector [n], matrix positive definite.

    Gauss-Jordan elimination, which needs no pivoting here: plain arithmetic that `vmap`
    turns into long vectors, where a library call would be made for each small system.
    """
    index = jnp.arange(len(vector))

    def eliminate(j: jax.Array, rows: jax.Array) -> jax.Array:
        pivot = rows[j] / rows[j, j]
        others = rows[:, j] - (index == j)  # leaves `pivot` in row j
        return rows - others[:, None] * pivot

    rows = jnp.concatenate([matrix, vector[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(vector), eliminate, rows)[:, -1]
