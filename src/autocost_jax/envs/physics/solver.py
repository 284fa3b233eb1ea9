"""MuJoCo's constraint solver for many small worlds at once.

The problem is MuJoCo's: over accelerations x of the nv degrees of freedom, minimise

    1/2 (x - a)' M (x - a) + 1/2 sum over rows i of D_i min(0, J_i x - r_i)^2

with mass matrix M, unconstrained acceleration a, and for each row of a contact's
pyramid or of a joint limit its Jacobian J_i, stiffness D_i and reference r_i. So is the
method, Newton with an exact line search. `mjx.solver.solve` does the same; this one
exists because that one factors every world's Hessian by a LAPACK call, which on a CPU
hangs where two of them meet in JAX's thread pool, and because it is a few times faster.

Worlds are lanes, the last axis of every array here, whatever was vmapped and in which
order; sums over rows and degrees of freedom are then sums of vectors of worlds, which
compilers make fast where a sum along the last axis stays scalar. A lane that has its
solution stands still, so that its numbers do not depend on its neighbours.

Source: MuJoCo documentation, Computation, "Primal problem"; engine_solver.c.
Differs: no rows but inequalities, no elliptic cones.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from mujoco import mjx

from autocost_jax.envs.physics.rows import EDGES, Inputs, build, inputs, make_rows

LINE_SEARCH_STEPS = 5
ROWS = 8  # rows are filled up to a multiple, so that sums over them can be halved
FULL_STEP = 1e-3  # how far from 1 the length of a full Newton step may be
# Lanes that a CPU solves together: a few vectors of its, and their rows fit its cache.
CPU_LANES = 32


class Problem(NamedTuple):
    """The minimisation in W worlds.

    Attributes:
      jacobian: [nv, n, W] J, columns first.
      stiffness: [n, W] D.
      reference: [n, W] r.
      mass: [nv, nv, W] M.
      smooth: [nv, W] a.
      force: [nv, W] M a.
      start: [nv, W] where to begin, if that is better than a.
    """

    jacobian: jax.Array
    stiffness: jax.Array
    reference: jax.Array
    mass: jax.Array
    smooth: jax.Array
    force: jax.Array
    start: jax.Array


def make_solver(
    mj_model: Any, data: mjx.Data
) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    """The solver of a `mujoco.MjModel`, as a function (model, data) -> data.

    It takes data after `mjx.fwd_acceleration` and sets the acceleration `qacc` [nv],
    `qfrc_constraint` [nv] and `_impl.efc_force` [nefc].

    Args:
      mj_model: see `rows.make_rows` for what it may contain.
      data: any of its data, for shapes and the kinds of contacts.

    Raises:
      ValueError: the model needs rows of another kind.
    """
    rows = make_rows(mj_model, data)
    impratio, iterations = float(mj_model.opt.impratio), int(mj_model.opt.iterations)

    def solve_lanes(
        given: Inputs, state: dict[str, jax.Array]
    ) -> tuple[jax.Array, ...]:
        problem = make_problem(*build(rows, impratio, given), state)
        qacc, force, push = minimise(problem, iterations)
        count = EDGES * len(given.depth) + len(given.limited)
        return qacc, force[:count], push

    solve = over_lanes(solve_lanes)

    def solve_constraints(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        state = {
            "mass": mjx.full_m(model, data),
            "smooth": data.qacc_smooth,
            "force": data.qfrc_smooth,
            "start": data.qacc_warmstart,
        }
        lanes = jax.tree.map(lambda x: x[..., None], (inputs(rows, data), state))
        qacc, force, push = (x[..., 0] for x in solve(*lanes))
        solved: Any = {
            "qacc": qacc,
            "qfrc_constraint": push,
            "_impl.efc_force": force,
        }
        result: Any = data.tree_replace(solved)
        return result

    return solve_constraints


def make_problem(
    jacobian: jax.Array,
    stiffness: jax.Array,
    reference: jax.Array,
    state: dict[str, jax.Array],
) -> Problem:
    """The minimisation; rows are filled up so that sums over them can be halved.

    Args:
      jacobian: [nv, n, W].
      stiffness: [n, W].
      reference: [n, W].
      state: the other fields.
    """
    spare = -len(stiffness) % ROWS
    fill = ((0, spare), (0, 0))
    return Problem(
        jacobian=jnp.pad(jacobian, ((0, 0), *fill)),
        stiffness=jnp.pad(stiffness, fill),
        reference=jnp.pad(reference, fill),
        **state,
    )


def over_lanes(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays [..., W] whose lanes every `vmap` joins.

    On a CPU it sees `CPU_LANES` of them at a time.
    """

    @custom_vmap
    def call(*arguments: Any) -> Any:
        return _in_blocks(function, arguments)

    @call.def_vmap
    def _(size: int, is_batched: Any, *arguments: Any):
        def join(x: jax.Array, is_batched: bool) -> jax.Array:
            if not is_batched:
                x = jnp.broadcast_to(x, (size, *x.shape))
            x = jnp.moveaxis(x, 0, -2)
            return x.reshape(*x.shape[:-2], size * x.shape[-1])

        def split(x: jax.Array) -> jax.Array:
            shape = (*x.shape[:-1], size, x.shape[-1] // size)
            return jnp.moveaxis(x.reshape(shape), -2, 0)

        result = call(*jax.tree.map(join, arguments, tuple(is_batched)))
        return jax.tree.map(split, result), jax.tree.map(lambda _: True, result)

    return call


def _in_blocks(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """`function` of all lanes; on a CPU of `CPU_LANES` at a time."""
    lanes = jax.tree.leaves(arguments)[0].shape[-1]
    if jax.default_backend() != "cpu" or lanes <= CPU_LANES:
        return function(*arguments)
    blocks = -(-lanes // CPU_LANES)

    def cut(x: jax.Array) -> jax.Array:
        spare = [(0, 0)] * (x.ndim - 1) + [(0, blocks * CPU_LANES - lanes)]
        x = jnp.pad(x, spare, mode="edge")
        return jnp.moveaxis(x.reshape(*x.shape[:-1], blocks, CPU_LANES), -2, 0)

    def join(x: jax.Array) -> jax.Array:
        x = jnp.moveaxis(x, 0, -2)
        return x.reshape(*x.shape[:-2], -1)[..., :lanes]

    cut_arguments = jax.tree.map(cut, arguments)
    result = jax.lax.map(lambda block: function(*block), cut_arguments)
    return jax.tree.map(join, result)


def minimise(problem: Problem, iterations: int) -> tuple[jax.Array, ...]:
    """Newton's method in every lane, from the better of two starts.

    A lane is done when a full step leaves its set of pushing rows as it was: along such
    a step the function is one quadratic, of which the step has reached the minimum.

    Args:
      problem: fields [..., W].
      iterations: steps at most; a CPU ends when all lanes are done.

    Returns:
      x [nv, W], the rows' forces [n, W] and their push J' force [nv, W].
    """
    jacobian, stiffness, reference, mass, smooth, force, start = problem

    def gap(x: jax.Array) -> jax.Array:
        return _mul(jacobian, x) - reference

    def cost(x: jax.Array) -> jax.Array:
        away, short = x - smooth, jnp.minimum(0.0, gap(x))
        return _sum(_mul(mass, away) * away) + _sum(stiffness * short * short)

    def is_open(carry: tuple) -> jax.Array:
        count, _, _, is_done = carry
        return (count < iterations) & ~is_done.all()

    def step(carry: tuple) -> tuple:
        count, x, distance, is_done = carry
        weight = jnp.where(distance < 0, stiffness, 0.0)
        gradient = _mul(mass, x) - force + _push(jacobian, weight * distance)
        direction = -solve_positive(mass + _gram(jacobian, weight), gradient)
        change = _mul(jacobian, direction)
        slope = _sum(gradient * direction)
        slope -= _sum(weight * distance * change)  # of the mass term alone
        curvature = _sum(_mul(mass, direction) * direction)
        length = _line_search(slope, curvature, stiffness, distance, change)
        moved = jnp.where(is_done, x, x + length * direction)
        reached = gap(moved)
        is_same = ((reached < 0) == (distance < 0)).all(0)
        is_full = jnp.abs(length - 1) < FULL_STEP
        return count + 1, moved, reached, is_done | (is_same & is_full)

    x = jnp.where(cost(start) < cost(smooth), start, smooth)
    carry = (jnp.zeros((), jnp.int32), x, gap(x), jnp.zeros(x.shape[-1:], bool))
    if jax.default_backend() == "cpu":
        _, x, distance, _ = jax.lax.while_loop(is_open, step, carry)
    else:  # asking the device each time would take longer than the steps
        carry = jax.lax.fori_loop(0, iterations, lambda _, carry: step(carry), carry)
        _, x, distance, _ = carry
    forces = -stiffness * jnp.minimum(0.0, distance)
    return x, forces, _push(jacobian, forces)


def _sum(x: jax.Array, axis: int = 0) -> jax.Array:
    """Sum along an axis that is not the last: halves are added, vector by vector."""
    size = x.shape[axis]
    while size % 2 == 0:
        size //= 2
        low = jax.lax.slice_in_dim(x, 0, size, axis=axis)
        x = low + jax.lax.slice_in_dim(x, size, 2 * size, axis=axis)
    parts = [jax.lax.index_in_dim(x, i, axis, keepdims=False) for i in range(size)]
    return functools.reduce(jnp.add, parts)


def _mul(columns: jax.Array, x: jax.Array) -> jax.Array:
    """[m, W] matrix times vector: columns [n, m, W], x [n, W]; exact float32."""
    return functools.reduce(jnp.add, [a * b for a, b in zip(columns, x, strict=True)])


def _push(jacobian: jax.Array, force: jax.Array) -> jax.Array:
    """[nv, W] J' force."""
    return _sum(jacobian * force, 1)


def _gram(jacobian: jax.Array, weight: jax.Array) -> jax.Array:
    """[nv, nv, W] J' diag(weight) J; the lower half is computed and mirrored."""
    size = len(jacobian)
    weighted = jacobian * weight
    rows = [
        jnp.pad(_sum(weighted[: i + 1] * jacobian[i], 1), ((0, size - i - 1), (0, 0)))
        for i in range(size)
    ]
    lower = jnp.stack(rows)
    index = jnp.arange(size)
    is_lower = (index <= index[:, None])[..., None]
    return jnp.where(is_lower, lower, jnp.swapaxes(lower, 0, 1))


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

    Args:
      slope: [W].
      curvature: [W].
      stiffness: [n, W].
      distance: [n, W].
      change: [n, W].

    Returns:
      t [W], at least 0.
    """
    pull = stiffness * change
    bend = pull * change

    def body(_, carry):
        t, low, high = carry
        short = jnp.minimum(0.0, distance + t * change)
        first = slope + curvature * t + _sum(pull * short)
        bent = _sum(jnp.where(short < 0, bend, 0.0))
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
    """The solution x [n, W] of matrix [n, n, W] x = vector [n, W], positive definite.

    Gauss-Jordan elimination, which needs no pivoting here: plain arithmetic on vectors
    of worlds, where a library call would be made for each small system.
    """
    index = jnp.arange(len(vector))[:, None]

    def eliminate(j: jax.Array, rows: jax.Array) -> jax.Array:
        pivot = rows[j] / rows[j, j]
        others = rows[:, j] - (index == j)  # leaves `pivot` in row j
        return rows - others[:, None] * pivot

    rows = jnp.concatenate([matrix, vector[:, None]], axis=1)
    return jax.lax.fori_loop(0, len(vector), eliminate, rows)[:, -1]
