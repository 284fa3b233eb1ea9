import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import fisher_product

from autocost_jax.agents.advantages import centre, normalise
from autocost_jax.agents.base import Batch
from autocost_jax.agents.cpo import cpo_step, surrogates, update_policy
from autocost_jax.agents.networks import log_prob
from autocost_jax.agents.trust_region import conjugate_gradient
from autocost_jax.config import AgentConfig

DELTA = 0.01
ROUNDED = 1e-7  # the goldens are printed with seven decimals
FLOAT32 = 2e-4  # relative, of a step whose terms may nearly cancel
H2 = np.array([[2, 0.6], [0.6, 1]])
G2 = np.array([1, -0.5])
H3 = np.array([[1.5, 0.2, -0.3], [0.2, 0.8, 0.1], [-0.3, 0.1, 0.5]])
G3 = np.array([0.3, -0.7, 0.2])
B3 = np.array([0.05, 0.1, -0.08])
PLAIN = (-0.0990665, 0.1219280)  # the step without a constraint, H2 and G2
Q2 = 1.2804878

# b, c, case, r, s, A, B, lam, nu, x (None: not defined for the row)
UP, DOWN = (0.2, 0.5), (0.4, -0.3)
RS_UP, RS_DOWN = (-0.3292683, 0.2560976, 0.8571429), (0.6097561, 0.2951220, 0.0206612)
RS_TINY = (-0.0032927, 2.560976e-5, 0.8571429)
TINY = (0.002, 0.005)
LAM = 8.0015242
ROWS = [
    ((0.0, 0.0), -0.01, 4, None, None, LAM, 0, PLAIN),
    (UP, -0.2, 3, RS_UP, -0.1361905, LAM, 0, PLAIN),
    (UP, -0.05, 2, RS_UP, 0.0102381, LAM, 0, PLAIN),
    (UP, -0.02, 2, RS_UP, 0.0184381, 6.8181818, 0.7532468, (-0.1095238, 0.0838095)),
    (DOWN, -0.02, 2, RS_DOWN, 0.0186446, LAM, 0, PLAIN),
    (UP, 0.0, 1, RS_UP, 0.02, 6.5465367, 1.2857143, (-0.1091089, 0.0436436)),
    (DOWN, 0.0, 1, RS_DOWN, 0.02, LAM, 0, PLAIN),
    (UP, 0.03, 1, RS_UP, 0.0164857, 7.2106219, 2.1303871, (-0.0919174, -0.0232331)),
    (DOWN, 0.03, 1, RS_DOWN, 0.0169504, LAM, 0, PLAIN),
    (DOWN, 0.075, 1, RS_DOWN, 0.0009401, LAM, 0, PLAIN),
    (UP, 0.2, 0, RS_UP, -0.1361905, 0, 0.2794553, (0.0170400, -0.1499516)),
    (TINY, 3e-4, 1, RS_TINY, 0.0164857, 7.2106219, 213.03871, (-0.0919174, -0.0232331)),
    (TINY, 1e-3, 0, RS_TINY, -0.0190476, 0, 27.945525, (0.0170400, -0.1499516)),
]


@functools.partial(jax.jit, static_argnames="use_cg")
def jitted_step(g, b, c, dense, use_cg):
    def product(rows):
        return rows @ dense

    def solve(rhs):
        if use_cg:
            return conjugate_gradient(product, rhs, 10)
        return jnp.linalg.solve(dense, rhs.T).T

    return cpo_step(g, b, c, product, DELTA, solve)


def solve_step(g, b, c, H, x64=True, use_cg=False):
    """`cpo_step` with an exact solve (or conjugate gradient), as NumPy arrays."""
    with jax.enable_x64(x64), jax.numpy_rank_promotion("raise"):
        dtype = jnp.result_type(float)
        x, info = jitted_step(*(jnp.asarray(a, dtype) for a in (g, b, c, H)), use_cg)
        assert x.dtype == dtype
        return np.asarray(x), {k: np.asarray(a) for k, a in info.items()}


@pytest.mark.parametrize("use_cg", [False, True])
@pytest.mark.parametrize("row", ROWS)
def test_two_dimensional_goldens(row, use_cg):
    b, c, case, rs, bound, lam, nu, x = row
    got, info = solve_step(G2, b, c, H2, use_cg=use_cg)
    np.testing.assert_allclose(got, x, atol=ROUNDED)
    assert info["case"] == case
    np.testing.assert_allclose(info["lam"], lam, rtol=ROUNDED)
    np.testing.assert_allclose(info["nu"], nu, rtol=2 * ROUNDED)
    np.testing.assert_allclose(info["q"], Q2, rtol=ROUNDED)
    if rs is not None:
        names = [info[name] for name in "rsA"]
        # printed with seven decimals, or seven digits
        np.testing.assert_allclose(names, rs, rtol=3e-6, atol=1e-8)
        np.testing.assert_allclose(info["B"], bound, atol=ROUNDED)
    assert 0.5 * got @ H2 @ got == pytest.approx(DELTA, rel=1e-6)
    low, info32 = solve_step(G2, b, c, H2, x64=False, use_cg=use_cg)
    np.testing.assert_allclose(low, x, rtol=FLOAT32, atol=FLOAT32 * 0.1)
    assert info32["case"] == case


@pytest.mark.parametrize(
    ("c", "case", "bound", "lam", "nu", "x"),
    [
        (-0.03, 3, -0.0089005, 7.5578160, 0, (-0.0715207, 0.1493683, -0.1257114)),
        (
            -0.005,
            2,
            0.0191972,
            3.9598145,
            4.5621634,
            (-0.1022545, 0.1023310, 0.0015048),
        ),
        (0, 1, 0.02, 3.8795280, 5.1979438, (-0.0994985, 0.0784527, 0.0358793)),
        (0.01, 1, 0.0167888, 4.2343190, 6.5576523, (-0.0816149, 0.0209412, 0.1001672)),
        (0.05, 0, -0.0602791, 0, 0.8013941, (0.0238252, -0.1271234, 0.1679429)),
    ],
)
def test_three_dimensional_goldens(c, case, bound, lam, nu, x):
    for use_cg in (False, True):
        got, info = solve_step(G3, B3, c, H3, use_cg=use_cg)
        np.testing.assert_allclose(got, x, atol=ROUNDED)
        assert info["case"] == case
        np.testing.assert_allclose(
            [info[name] for name in ("lam", "nu", "B", "q", "r", "s", "A")],
            (lam, nu, bound, 1.1424116, -0.1618711, 0.0311414, 0.3010147),
            atol=2 * ROUNDED,
        )


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 0.1, 10.0, 1e3])
@pytest.mark.parametrize("row", ROWS[1:])
def test_scaling_the_constraint_or_the_gradient_changes_nothing(row, scale):
    b, c = np.array(row[0]), row[1]
    x, _ = solve_step(G2, b, c, H2)
    if c >= 0 or np.linalg.norm(scale * b) > 1e-4:  # below it case 4 takes over
        np.testing.assert_allclose(
            solve_step(G2, scale * b, scale * c, H2)[0], x, atol=1e-9
        )
    np.testing.assert_allclose(solve_step(scale * G2, b, c, H2)[0], x, atol=1e-9)
    np.testing.assert_allclose(solve_step(-G2, -b, c, H2)[0], -x, atol=1e-9)


@pytest.mark.parametrize("x64", [True, False])
@pytest.mark.parametrize(
    ("g", "b", "c", "x"),
    [
        (G2, UP, -0.0, (-0.1091089, 0.0436436)),
        (G2, DOWN, -0.0, PLAIN),
        (G2, -G2, 0.0, (0, 0)),
        (G2, -G2, 0.01, (0.0061905, -0.0076190)),
        (G2, G2, -0.01, PLAIN),
        (G2, (1.0, 0.8125), 0.0, PLAIN),
        (G2, (0.0, 0.0), -0.01, PLAIN),
        (G2, (0.0, 0.0), 0.0, PLAIN),
        (G2, (0.0, 0.0), 0.01, PLAIN),
        ((0.0, 0.0), (0.0, 0.0), 0.0, (0, 0)),
        ((0.0, 0.0), UP, 0.0, (0, 0)),
        ((0.0, 0.0), UP, 0.2, (0.0170400, -0.1499516)),
        (G2, (1e-30, -1e-30), 0.1, PLAIN),
    ],
)
def test_edge_inputs(g, b, c, x, x64):
    # In float32 a vanishing u is rounding (1e-8) blown up by sqrt(B / 1e-12).
    tolerance = ROUNDED if x64 else 2e-3
    for use_cg in (False, True):
        got, info = solve_step(g, b, c, H2, x64=x64, use_cg=use_cg)
        np.testing.assert_allclose(got, x, atol=tolerance)
        assert all(np.all(np.isfinite(value)) for value in info.values())


def exact_step(g, b, c, H):
    """Enumeration of the KKT candidates in two dimensions, float64, independent.

    In y = L^T x (H = L L^T) the region is a disc; the optimum is its lowest point
    along g, or a corner of the disc and the half plane, or (no feasible point)
    its lowest point along b.
    """
    inverse = np.linalg.inv(np.linalg.cholesky(H))
    g, b = inverse @ g, inverse @ b
    radius = np.sqrt(2 * DELTA)
    norm = np.linalg.norm(b)
    candidates = [-radius * g / np.linalg.norm(g)]
    offset = -c / norm
    if abs(offset) <= radius:
        along = np.array([-b[1], b[0]]) / norm
        half = np.sqrt(radius**2 - offset**2)
        candidates += [offset * b / norm + sign * half * along for sign in (-1, 1)]
    slack = 1e-12 * radius * norm
    feasible = [y for y in candidates if c + b @ y <= slack]
    best = min(feasible, key=lambda y: g @ y) if feasible else -radius * b / norm
    return inverse.T @ best


def random_problems(count, low, high, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, 2, 2))
    H = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    g = rng.normal(size=(count, 2))
    b = rng.normal(size=(count, 2))
    b *= (10 ** rng.uniform(low, high, count) / np.linalg.norm(b, axis=1))[:, None]
    s = np.einsum("ni,ni->n", b, np.linalg.solve(H, b[..., None])[..., 0])
    c = rng.normal(size=count) * np.sqrt(2 * DELTA * s)
    small = np.linalg.norm(b, axis=1) <= 1.01e-4
    c = np.where(small, np.abs(c), c)  # case 4 answers another question
    return g, b, c, H


def batch_steps(g, b, c, H, dtype):
    def one(g, b, c, H):
        def solve(rhs):  # two unknowns: Cramer's rule
            det = H[0, 0] * H[1, 1] - H[0, 1] ** 2
            adjoint = jnp.array([[H[1, 1], -H[0, 1]], [-H[0, 1], H[0, 0]]])
            return rhs @ adjoint / det

        return cpo_step(g, b, c, lambda rows: rows @ H, DELTA, solve)

    with jax.enable_x64(dtype == np.float64):
        arrays = (jnp.asarray(a, dtype) for a in (g, b, c, H))
        x, info = jax.jit(jax.vmap(one))(*arrays)
        return np.asarray(x, np.float64), np.asarray(info["case"])


# The bounds on the median and the 99 % quantile are ten times what the analysis of
# the form found; norms of b down to 1e-7 are where costs near zero violation live.
@pytest.mark.parametrize(
    ("dtype", "median", "quantile"),
    [(np.float64, 1e-12, 1e-7), (np.float32, 1e-6, 2e-4)],
)
@pytest.mark.parametrize("size", [(-7, -5), (-5, -4), (-4, -3), (-3, -2), (-2, 0)])
def test_random_problems_against_an_exact_solver(size, dtype, median, quantile):
    g, b, c, H = random_problems(1000, *size)
    x, case = batch_steps(g, b, c, H, dtype)
    exact = np.array([exact_step(*p) for p in zip(g, b, c, H, strict=True)])
    error = np.linalg.norm(x - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert np.median(error) < median
    assert np.quantile(error, 0.99) < quantile
    assert set(case) >= {0, 1}
    kl = 0.5 * np.einsum("ni,nij,nj->n", x, H, x)
    assert kl.max() <= DELTA * (1 + 1e-3)
    s = np.einsum("ni,ni->n", b, np.linalg.solve(H, b[..., None])[..., 0])
    overshoot = c + np.einsum("ni,ni->n", b, x)
    bound = (case == 1) | (case == 2)
    assert np.all(overshoot[bound] <= 1e-3 * np.sqrt(2 * DELTA * s[bound]))


def test_random_problems_against_slsqp():
    optimize = pytest.importorskip("scipy.optimize")
    g, b, c, H = random_problems(20, -2, 0, seed=3)
    x, case = batch_steps(g, b, c, H, np.float64)
    for i in np.flatnonzero(case > 0):
        result = optimize.minimize(
            lambda y, i=i: g[i] @ y,
            0.5 * x[i],
            jac=lambda y, i=i: g[i],
            method="SLSQP",
            constraints=[
                {"type": "ineq", "fun": lambda y, i=i: -(c[i] + b[i] @ y)},
                {"type": "ineq", "fun": lambda y, i=i: DELTA - 0.5 * y @ H[i] @ y},
            ],
            options={"ftol": 1e-14, "maxiter": 500},
        )
        assert g[i] @ x[i] <= result.fun + 1e-6 * abs(result.fun)


# --- the whole policy update on a policy without a state -------------------------

ACTION = [(-1, 0.5), (0.2, -0.7), (0.9, 1.1), (-0.4, -1.2), (1.5, 0.1), (-0.6, 0.8)]
ADVANTAGE = [0.5, -0.3, 1.2, -1, 0.4, 0.1]
COST_ADVANTAGE = [0.1, 0, 0.6, 0.05, 0.3, 0.2]


def bandit(num_dead=0):
    """The golden's batch, followed by rows of weight 0, and its policy."""
    rows = len(ACTION) + num_dead
    weight = jnp.ones(rows).at[len(ACTION) :].set(0.0)

    def pad(values):
        values = jnp.asarray(values, weight.dtype)
        extra = jnp.full((num_dead, *values.shape[1:]), 7.0, values.dtype)
        return jnp.concatenate([values, extra])

    action = pad(ACTION)
    mean, log_std = jnp.zeros((rows, 2)), jnp.zeros(2)
    batch = Batch(
        obs=jnp.zeros((rows, 1)),
        action=action,
        weight=weight,
        mean_old=mean,
        log_std_old=log_std,
        log_prob_old=log_prob(action, mean, log_std),
        advantage=normalise(pad(ADVANTAGE), weight),
        cost_advantage=centre(pad(COST_ADVANTAGE), weight),
        target=jnp.zeros((rows, 2)),
    )

    def distribution(theta):
        return jnp.broadcast_to(theta, (rows, 2)), jnp.zeros(2, theta.dtype)

    return batch, distribution


@functools.partial(jax.jit, static_argnames="num_dead")
def bandit_step(theta, batch, c, num_dead=0):
    """`update_policy` of the bandit, one program for all goldens."""
    _, distribution = bandit(num_dead)
    config = AgentConfig()
    product = fisher_product(distribution, theta, batch.weight, config.cg_damping)
    return update_policy(config, distribution, theta, batch, c, product)


GOLDEN = [
    (-0.2, 3, (0.0558586, 0.1227259), 0, (0.0090909, -0.1083450, 0.0210599)),
    (-0.02, 2, (0.0477308, 0.1261094), 1, (0.0058182, -0.0863775, 0.0163585)),
    (-0.005, 2, (-0.0779054, 0.1100571), 0, (0.0090909, -0.0536508, 0.0046717)),
    (0.0, 1, (-0.1015214, 0.0887425), 0, (0.0090909, -0.0313536, -0.0002320)),
    (0.01, 1, (-0.1312684, 0.0308290), 0, (0.0090909, 0.0183204, -0.0096713)),
    (0.02, 1, (-0.1185940, -0.0641661), 0, (0.0090909, 0.0829682, -0.0189057)),
    (0.1, 0, (-0.0887425, -0.1015214), 0, (0.0090909, 0.1017641, -0.0202909)),
]


@pytest.mark.parametrize("num_dead", [0, 3])
@pytest.mark.parametrize(("c", "case", "step", "j", "at"), GOLDEN)
def test_update_golden(c, case, step, j, at, num_dead):
    with jax.enable_x64(True):
        batch, _ = bandit(num_dead)
        theta, metrics = bandit_step(jnp.zeros(2), batch, jnp.asarray(c), num_dead)
    np.testing.assert_allclose(theta, 0.8**j * np.array(step), atol=2e-7)
    assert metrics["case"] == case
    assert metrics["accepted"]
    np.testing.assert_allclose(metrics["step_fraction"], 0.8**j)
    names = ("kl", "policy_loss", "cost_surrogate")
    # at a step known to 1e-7 per component
    np.testing.assert_allclose([metrics[n] for n in names], at, atol=2e-7)
    norms = np.linalg.norm([(-0.3333541, -0.7324056), (0.1041667, 0.1191667)], axis=1)
    got = [metrics["policy_grad_norm"], metrics["cost_grad_norm"]]
    np.testing.assert_allclose(got, norms, atol=ROUNDED)


def test_full_step_of_the_row_that_backtracks_breaks_the_bound():
    with jax.enable_x64(True):
        batch, distribution = bandit()
        cost = surrogates(distribution(jnp.array((0.0477308, 0.1261094))), batch)[1]
    assert cost == pytest.approx(0.0205407, abs=2e-7)


def test_update_keeps_the_bits_if_every_candidate_fails():
    """Old rows that claim another old policy: the KL is out of bounds everywhere."""
    batch, _ = bandit()
    batch = batch.replace(mean_old=batch.mean_old + 5.0)
    theta = jnp.array([0.1, -0.7])
    new, metrics = bandit_step(theta, batch, jnp.asarray(0.0))
    np.testing.assert_array_equal(new, theta)
    assert not metrics["accepted"]
    assert metrics["step_fraction"] == 0
    assert metrics["kl"] == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_update_keeps_the_bits_if_the_violation_is_not_finite(bad):
    batch, _ = bandit()
    theta = jnp.array([0.0, 0.0])
    new, metrics = bandit_step(theta, batch, jnp.asarray(bad))
    assert np.all(np.isfinite(new))
    if np.isnan(bad):
        np.testing.assert_array_equal(new, theta)
        assert not metrics["accepted"]


def test_update_is_finite_for_every_degenerate_batch_under_vmap():
    batch, _ = bandit()
    zero = jnp.zeros(6)
    grid = itertools.product((zero, batch.advantage), (zero, batch.cost_advantage))
    both = [jnp.stack(pair) for pair in grid for _ in range(3)]
    c = jnp.tile(jnp.array([-0.01, 0.0, 0.01]), 4)

    def one(pair, c):
        changed = batch.replace(advantage=pair[0], cost_advantage=pair[1])
        return bandit_step(jnp.zeros(2), changed, c)

    theta, metrics = jax.jit(jax.vmap(one))(jnp.stack(both), c)
    assert np.all(np.isfinite(theta))
    for name, value in metrics.items():
        assert np.all(np.isfinite(value)), name
    np.testing.assert_array_equal(theta[:3], 0)
