"""The constraint solver: the minimum, in every lane, whatever is beside it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from autocost_jax.envs.physics.solver import (
    CPU_LANES,
    Problem,
    minimise,
    over_lanes,
    solve_positive,
)

NV, ROWS, ITERATIONS = 7, 24, 12


def problems(lanes: int, seed: int = 0) -> Problem:
    """Random problems of float32, some rows of which push."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(lanes, NV, NV))
    mass = factor @ factor.transpose(0, 2, 1) + np.eye(NV)
    smooth = rng.normal(size=(lanes, NV))
    fields = {
        "jacobian": rng.normal(size=(lanes, NV, ROWS)),
        "stiffness": np.exp(rng.normal(size=(lanes, ROWS))),
        "reference": rng.normal(size=(lanes, ROWS)),
        "mass": mass,
        "smooth": smooth,
        "force": np.einsum("wij,wj->wi", mass, smooth),
        "start": smooth + rng.normal(size=(lanes, NV)),
    }
    return Problem(**{name: jnp.asarray(x, jnp.float32) for name, x in fields.items()})


def as_lanes(batch: Problem) -> Problem:
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), batch)


def solve(batch: Problem) -> np.ndarray:
    """x [W, nv] of problems with the lane as their first axis."""
    return np.asarray(
        jax.jit(minimise, static_argnums=1)(as_lanes(batch), ITERATIONS)[0]
    ).T


def one(problem: Problem) -> jax.Array:
    """x [nv] of one world, as the physics asks for it."""
    lane = jax.tree.map(lambda x: x[..., None], problem)
    return over_lanes(functools.partial(minimise, iterations=ITERATIONS))(lane)[0][
        ..., 0
    ]


def cost(p: Problem, x: np.ndarray) -> float:
    away, short = x - p.smooth, np.minimum(0, p.jacobian.T @ x - p.reference)
    return float(away @ p.mass @ away / 2 + (p.stiffness * short**2).sum() / 2)


@pytest.mark.parametrize(("stiffness", "mass"), [(1.0, 1.0), (1e4, 1.0), (1e3, 1e-3)])
def test_it_finds_the_minimum(stiffness, mass):
    """Also for stiff rows on light bodies, where first steps are cut short."""
    batch = problems(20)
    batch = batch._replace(
        stiffness=stiffness * batch.stiffness,
        mass=mass * batch.mass,
        force=mass * batch.force,
    )
    found = solve(batch)
    for lane in range(20):
        p = jax.tree.map(lambda x, lane=lane: np.asarray(x[lane], np.float64), batch)
        starts = (p.smooth, p.start, found[lane].astype(np.float64))
        lowest = min(
            minimize(lambda x, p=p: cost(p, x), start, method="BFGS").fun
            for start in starts
        )
        assert cost(p, found[lane]) <= lowest * (1 + 1e-3) + 1e-5
    if stiffness == mass == 1.0:
        best = minimize(lambda x: cost(p, x), p.smooth, options={"gtol": 1e-9})
        np.testing.assert_allclose(found[lane], best.x, atol=2e-4)


def test_forces_are_those_of_the_rows_and_balance():
    p = as_lanes(problems(5))
    x, forces, push = minimise(p, ITERATIONS)
    gap = jnp.einsum("jnw,jw->nw", p.jacobian, x) - p.reference
    expected = -p.stiffness * jnp.minimum(0, gap)
    np.testing.assert_allclose(forces, expected, atol=1e-4)
    rest = jnp.einsum("ijw,jw->iw", p.mass, x - p.smooth) - push
    np.testing.assert_allclose(rest, 0 * rest, atol=2e-3)


@pytest.mark.parametrize("lanes", [1, CPU_LANES, CPU_LANES + 3, 3 * CPU_LANES])
def test_any_number_of_lanes_under_vmap(lanes):
    batch = problems(lanes)
    got = jax.jit(jax.vmap(one))(batch)
    np.testing.assert_allclose(got, solve(batch), atol=1e-5)


def test_two_vmaps_and_constants_are_lanes_too():
    batch = problems(6)
    mass = batch.mass[0]
    shared = batch._replace(mass=mass, force=batch.smooth @ mass)
    axes = Problem(0, 0, 0, None, 0, 0, 0)  # type: ignore[arg-type]
    flat = jax.vmap(one, in_axes=(axes,))(shared)
    pairs = jax.tree.map(
        lambda x: x if x is mass else x.reshape(2, 3, *x.shape[1:]), shared
    )
    got = jax.vmap(jax.vmap(one, in_axes=(axes,)), in_axes=(axes,))(pairs)
    np.testing.assert_array_equal(got.reshape(6, NV), flat)


def test_a_lane_does_not_feel_its_neighbours():
    """Same bits beside easy problems, hard ones, and a NaN."""
    first, others = problems(CPU_LANES), problems(CPU_LANES, seed=1)
    mixed = jax.tree.map(lambda a, b: jnp.concatenate([a[:1], b[1:]]), first, others)
    broken = mixed._replace(smooth=mixed.smooth.at[3].set(jnp.nan))
    alone, beside, near_nan = solve(first)[0], solve(mixed)[0], solve(broken)
    np.testing.assert_array_equal(beside, alone)
    np.testing.assert_array_equal(near_nan[0], alone)
    assert np.isnan(near_nan[3]).all()


def test_more_steps_change_nothing_once_a_lane_is_done():
    p = as_lanes(problems(8))
    twelve, thirty = (minimise(p, count)[0] for count in (12, 30))
    np.testing.assert_array_equal(twelve, thirty)


def test_solve_positive_solves():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(19, 19))
    matrix, vector = factor @ factor.T + np.eye(19), rng.normal(size=19)
    got = jax.jit(solve_positive)(
        jnp.asarray(matrix)[..., None], jnp.asarray(vector)[:, None]
    )
    expected = np.linalg.solve(matrix, vector)
    np.testing.assert_allclose(got[:, 0], expected, rtol=2e-3)
