import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.agents.advantages import centre, gae, normalise, weighted_mean

ROUNDED = 5e-8  # the goldens are printed with seven decimals
FLOAT32 = 1e-5  # float32 algebra against NumPy float64
REWARD = (1, 0, 0.5, -1, 2)
VALUE = (0.5, 0.4, 0.3, 0.2, 0.1)


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_rank_promotion("raise"):
        yield


def slow_gae(reward, value, gamma, lam):
    """O(T^2) sums of the definition, one world, float64."""
    horizon = len(reward)
    delta = [reward[t] + gamma * value[t + 1] - value[t] for t in range(horizon)]
    advantage = [
        sum((gamma * lam) ** (k - t) * delta[k] for k in range(t, horizon))
        for t in range(horizon)
    ]
    target = [
        sum(gamma ** (k - t) * reward[k] for k in range(t, horizon))
        + gamma ** (horizon - t) * value[horizon]
        for t in range(horizon)
    ]
    return np.array(advantage), np.array(target)


@pytest.mark.parametrize(
    ("last", "advantage", "target"),
    [
        (
            0.6,
            (2.3100267, 1.4724844, 1.6406169, 1.2939882, 2.494),
            (3.0115370, 2.0318556, 2.0523794, 1.5680600, 2.594),
        ),
        (
            0.0,
            (1.8048840, 0.9464584, 1.0928443, 0.7235700, 1.9),
            (2.4409430, 1.4554980, 1.4702, 0.98, 2),
        ),
    ],
)
def test_golden(last, advantage, target):
    with jax.enable_x64(True):
        reward = jnp.array(REWARD)[:, None]
        value = jnp.array((*VALUE, last))[:, None]
        got = gae(reward, value, 0.99, 0.97)
    np.testing.assert_allclose(got[0][:, 0], advantage, atol=ROUNDED)
    np.testing.assert_allclose(got[1][:, 0], target, atol=ROUNDED)


def test_golden_normalised_and_centred():
    with jax.enable_x64(True):
        a = jnp.array((2.3100267, 1.4724844, 1.6406169, 1.2939882, 2.494))
        one = jnp.ones(5)
        normal, centred = normalise(a, one), centre(a, one)
    # the input itself is rounded to seven decimals
    np.testing.assert_allclose(
        normal, (0.9877247, -0.7806701, -0.4256736, -1.1575486, 1.3761676), atol=3e-7
    )
    np.testing.assert_allclose(
        centred, (0.4678035, -0.3697389, -0.2016064, -0.5482350, 0.6517768), atol=2e-7
    )


@pytest.mark.parametrize("lam", [0.0, 0.97, 1.0])
def test_against_the_definition(lam):
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(50, 3)), rng.normal(size=(51, 3))
    got = gae(jnp.array(reward), jnp.array(value), 0.99, lam)
    for n in range(3):
        advantage, target = slow_gae(reward[:, n], value[:, n], 0.99, lam)
        np.testing.assert_allclose(got[0][:, n], advantage, atol=FLOAT32 * 10)
        np.testing.assert_allclose(got[1][:, n], target, atol=FLOAT32 * 10)
        if lam == 0.0:
            delta = reward[:, n] + 0.99 * value[1:, n] - value[:-1, n]
            np.testing.assert_allclose(got[0][:, n], delta, atol=FLOAT32)
        if lam == 1.0:
            np.testing.assert_allclose(
                got[0][:, n], target - value[:-1, n], atol=FLOAT32 * 10
            )


def test_failed_world_is_cut_and_bootstrapped():
    rng = np.random.default_rng(1)
    reward, value = rng.normal(size=(9, 2)), rng.normal(size=(10, 2))
    valid = np.ones((9, 2))
    valid[5:, 1] = 0
    reward[5:, 1] = 0
    got = gae(jnp.array(reward), jnp.array(value), 0.99, 0.97, jnp.array(valid))
    whole = slow_gae(reward[:, 0], value[:, 0], 0.99, 0.97)
    cut = slow_gae(reward[:5, 1], value[:6, 1], 0.99, 0.97)
    for i in range(2):
        np.testing.assert_allclose(got[i][:, 0], whole[i], atol=FLOAT32)
        np.testing.assert_allclose(got[i][:5, 1], cut[i], atol=FLOAT32)
    np.testing.assert_array_equal(got[0][5:, 1], 0)
    np.testing.assert_allclose(got[1][5:, 1], value[5:-1, 1], atol=FLOAT32)


def test_wrong_length_is_refused():
    with pytest.raises(AssertionError):
        gae(jnp.zeros((4, 2)), jnp.zeros((4, 2)), 0.9, 0.9)


def test_weighted_statistics_ignore_what_has_no_weight():
    x = jnp.array([1.0, 2.0, 4.0, 0.0])
    weight = jnp.array([1.0, 1.0, 1.0, 0.0])
    kept = np.array([1.0, 2.0, 4.0])
    assert weighted_mean(x, weight) == pytest.approx(kept.mean())
    expect = (kept - kept.mean()) / (kept.std() + 1e-8)
    np.testing.assert_allclose(normalise(x, weight), [*expect, 0], atol=FLOAT32)
    np.testing.assert_allclose(
        centre(x, weight), [*(kept - kept.mean()), 0], atol=FLOAT32
    )
    none = jnp.zeros(4)
    for function in (weighted_mean, normalise, centre):
        assert np.all(function(x, none) == 0)
    assert np.all(normalise(jnp.ones(4), jnp.ones(4)) == 0)
