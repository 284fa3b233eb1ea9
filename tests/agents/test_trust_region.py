import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import fisher_product
from jax.flatten_util import ravel_pytree

from autocost_jax.agents import blocks as row_blocks
from autocost_jax.agents import fisher
from autocost_jax.agents.advantages import weighted_mean
from autocost_jax.agents.networks import kl_divergence, make_networks
from autocost_jax.agents.trust_region import (
    backtrack,
    conjugate_gradient,
)
from autocost_jax.config import AgentConfig

ROUNDED = 5e-8  # the goldens are printed with seven decimals
H3 = np.array([[1.5, 0.2, -0.3], [0.2, 0.8, 0.1], [-0.3, 0.1, 0.5]])
G3 = np.array([0.3, -0.7, 0.2])
B3 = np.array([0.05, 0.1, -0.08])


def times(H):
    return lambda rows: rows @ jnp.asarray(H, rows.dtype)


@pytest.mark.parametrize(
    ("iterations", "expect", "residual"),
    [
        (1, (0.4661654, -1.0877193, 0.3107769), 0.3097),
        (2, (0.4026333, -1.1820174, 0.8004445), 0.1963),
        (3, (0.5405405, -1.1288981, 0.9501040), 0.0),
        (10, (0.5405405, -1.1288981, 0.9501040), 0.0),
    ],
)
def test_conjugate_gradient_golden(iterations, expect, residual):
    with jax.enable_x64(True), jax.numpy_rank_promotion("raise"):
        x = conjugate_gradient(times(H3), jnp.array([G3, B3]), iterations)
    np.testing.assert_allclose(x[0], expect, atol=2 * ROUNDED)
    assert np.linalg.norm(G3 - H3 @ x[0]) == pytest.approx(residual, abs=5e-5)
    if iterations >= 3:
        expect = (-0.0297297, 0.1586279, -0.2095634)
        np.testing.assert_allclose(x[1], expect, atol=2 * ROUNDED)


def test_conjugate_gradient_against_solve():
    rng = np.random.default_rng(0)
    for n in (2, 6, 10):
        root = rng.normal(size=(n, n))
        H = root @ root.T + np.eye(n)
        rhs = rng.normal(size=(2, n))
        rhs /= np.linalg.norm(rhs, axis=1, keepdims=True)
        with jax.enable_x64(True):
            x = conjugate_gradient(times(H), jnp.array(rhs), n + 4)
        # 1e-20 is the squared residual at which the recurrence rests
        np.testing.assert_allclose(x, np.linalg.solve(H, rhs.T).T, atol=1e-8)


def test_conjugate_gradient_does_not_amplify_rounding():
    """A spectrum like a Fisher matrix's: a dozen directions above the damping.

    In float32 the bare recurrence is up to 0.08 of the solution away from its own
    float64 result after ten iterations.
    """
    rng = np.random.default_rng(0)
    n = 400
    rotation, _ = np.linalg.qr(rng.normal(size=(n, n)))
    spectrum = np.concatenate([np.geomspace(1.0, 1e3, 12), np.full(n - 12, 0.1)])
    H = ((rotation * spectrum) @ rotation.T).astype(np.float32)
    rhs = rng.normal(size=(8, n)).astype(np.float32)
    rhs /= np.linalg.norm(rhs, axis=1, keepdims=True)
    single = conjugate_gradient(times(H), jnp.array(rhs), 10)
    with jax.enable_x64(True):
        H64, rhs64 = H.astype(np.float64), rhs.astype(np.float64)
        double = conjugate_gradient(times(H64), jnp.array(rhs64), 10)
    assert double.dtype == np.float64
    size = np.abs(double).max(axis=1)
    assert np.all(np.abs(single - double).max(axis=1) < 3e-5 * size)


@pytest.mark.parametrize("H", [np.zeros((3, 3)), -np.eye(3), H3])
def test_conjugate_gradient_stays_finite(H):
    """Zero right-hand sides, no curvature, negative curvature, tiny inputs."""
    rhs = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e-30, 0.0, 0.0]])
    x = conjugate_gradient(times(H), rhs, 30)
    assert np.all(np.isfinite(x))
    np.testing.assert_array_equal(x[0], 0)


def network_problem():
    networks = make_networks(AgentConfig(hidden_sizes=(6, 5)), 4, 3)
    params, _ = jax.jit(networks.init)(jax.random.key(1))
    params["log_std"] = jnp.array([-0.5, 0.2, -1.0])
    theta, unravel = ravel_pytree(params)
    obs = jax.random.normal(jax.random.key(2), (12, 4))
    weight = jnp.ones(12).at[9:].set(0.0)
    return theta, lambda t: networks.distribution(unravel(t), obs), weight


def test_fisher_product_is_the_hessian_of_the_kl():
    with jax.enable_x64(True):
        theta, distribution, weight = network_problem()
        old = distribution(theta)

        def forward(t):
            return weighted_mean(kl_divergence(*distribution(t), *old), weight)

        def backward(t):
            return weighted_mean(kl_divergence(*old, *distribution(t)), weight)

        product = fisher_product(distribution, theta, weight, 0.1)
        dense = jax.jit(product)(jnp.eye(theta.size))
        for kl in (forward, backward):
            hessian = jax.jit(jax.hessian(kl))(theta) + 0.1 * jnp.eye(theta.size)
            # the KL's variance carries 1e-8, the product's does not
            np.testing.assert_allclose(dense, hessian, atol=1e-6)
        np.testing.assert_allclose(dense, dense.T, atol=1e-12)
        assert np.linalg.eigvalsh(dense).min() > 0.1 - 1e-9


def test_fisher_product_in_float32():
    theta, distribution, weight = network_problem()
    product = fisher_product(distribution, theta, weight, 0.1)
    dense = jax.jit(product)(jnp.eye(theta.size))
    np.testing.assert_allclose(dense, dense.T, atol=1e-5)  # float32 sums
    jacobian = jax.jit(jax.jacobian(distribution))(theta)
    mean, log_std = (np.asarray(part, np.float64) for part in jacobian)
    scale = weight[:, None] / 9 * np.exp(-2 * np.array([-0.5, 0.2, -1.0]))
    expect = np.einsum("rui,ru,ruj->ij", mean, scale, mean)
    expect += 2 * log_std.T @ log_std + 0.1 * np.eye(theta.size)
    np.testing.assert_allclose(dense, expect, atol=1e-5)  # float32 sums


@pytest.mark.parametrize(
    ("hidden_sizes", "blocks"), [((), 1), ((6,), 4), ((6, 5), 4), ((4, 7, 3), 1)]
)
def test_factored_fisher_product_equals_the_generic_one(
    hidden_sizes, blocks, monkeypatch
):
    monkeypatch.setattr(fisher, "num_row_blocks", lambda rows: blocks)
    with jax.enable_x64(True):
        networks = make_networks(AgentConfig(hidden_sizes=hidden_sizes), 4, 3)
        params, _ = jax.jit(networks.init)(jax.random.key(1))
        params["log_std"] = jnp.array([-0.5, 0.2, -1.0])
        theta, unravel = ravel_pytree(params)
        obs = jax.random.normal(jax.random.key(2), (12, 4))
        weight = jnp.ones(12).at[9:].set(0.0)
        z = jax.random.normal(jax.random.key(3), (2, theta.size))

        def distribution(theta):
            return networks.distribution(unravel(theta), obs)

        expect = jax.jit(fisher_product(distribution, theta, weight, 0.1))(z)
        got = jax.jit(fisher.mlp_fisher_product(params, obs, weight, 0.1))(z)
    np.testing.assert_allclose(got, expect, atol=1e-12)  # float64 sums


def test_row_blocks_divide_the_rows():
    for rows in (1, 7, 160, 8000, 30_000, 30_001):
        assert rows % row_blocks.num_row_blocks(rows) == 0


def test_backtrack_takes_the_first_acceptable_candidate():
    theta, step = jnp.array([1.0, 2.0]), jnp.array([1.0, -1.0])
    calls = [0.8**j for j in range(10)]
    for j in range(10):
        limit = 1 + calls[j] * 1.0001

        def evaluate(t, limit=limit):
            return t[0] <= limit, {"first": t[0]}

        new, accepted, fraction, info = backtrack(evaluate, theta, step, 0.8, 10)
        assert bool(accepted)
        assert fraction == pytest.approx(calls[j], rel=1e-5)
        np.testing.assert_allclose(new, theta + calls[j] * step, rtol=1e-6)
        np.testing.assert_array_equal(info["first"], new[0])


def test_backtrack_rejects_nan_and_keeps_the_old_bits():
    theta = jnp.array([0.1, -0.3])
    for step in (jnp.array([jnp.nan, 1.0]), jnp.array([jnp.inf, 0.0]), jnp.ones(2)):
        new, accepted, fraction, _ = backtrack(
            lambda t: (jnp.sum(t) <= -9.0, t[0]), theta, step, 0.8, 10
        )
        assert not accepted
        assert fraction == 0
        np.testing.assert_array_equal(new, theta)
