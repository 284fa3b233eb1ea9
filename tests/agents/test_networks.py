import copy

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.agents.networks import (
    entropy,
    kl_divergence,
    log_prob,
    make_networks,
    sample,
)
from autocost_jax.config import AgentConfig

ROUNDED = 5e-8  # the goldens are printed with seven decimals


def size(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@pytest.fixture(scope="module")
def nets():
    networks = make_networks(AgentConfig(), 28, 2)
    return networks, *jax.jit(networks.init)(jax.random.key(0))


def test_parameter_counts(nets):
    _, policy, critic = nets
    assert size(policy) == 73_732
    assert size(critic) == 2 * 73_473
    for o, a in ((5, 1), (60, 12)):
        policy, critic = make_networks(AgentConfig(), o, a).init(jax.random.key(1))
        assert size(policy) == 256 * (o + 1) + 256 * 257 + 257 * a + a
        assert size(critic) == 2 * (256 * (o + 1) + 256 * 257 + 257)


def test_init_is_glorot_uniform_with_zero_biases(nets):
    _, policy, critic = nets
    assert np.all(policy["log_std"] == np.float32(-0.5))
    layers = [*policy["mean"].values(), *critic.values()]
    for layer in layers:
        kernel, bias = np.asarray(layer["kernel"]), layer["bias"]
        bound = np.sqrt(6 / (kernel.shape[-2] + kernel.shape[-1]))
        assert np.all(bias == 0)
        assert np.abs(kernel).max() <= bound
        assert np.abs(kernel).max() > 0.97 * bound
        # 5 sigmas of the standard deviation of the smallest kernel (256 entries)
        assert kernel.std() == pytest.approx(bound / np.sqrt(3), rel=0.15)


def test_policy_may_begin_all_but_still(nets):
    """A scaled last layer, all else as without."""
    _, policy, critic = copy.deepcopy(nets)
    small = make_networks(AgentConfig(policy_output_scale=0.01), 28, 2)
    policy_small, critic_small = jax.jit(small.init)(jax.random.key(0))
    last = "Dense_2"
    scaled = 0.01 * policy["mean"].pop(last)["kernel"]
    got = policy_small["mean"].pop(last)["kernel"]
    np.testing.assert_allclose(got, scaled, rtol=1e-5)
    chex.assert_trees_all_equal((policy_small, critic_small), (policy, critic))


def test_critics_are_two_separate_nets(nets):
    networks, _, critic = nets
    obs = jax.random.uniform(jax.random.key(2), (5, 4, 28))
    values = networks.values(critic, obs)
    assert values.shape == (2, 5, 4)
    assert not np.allclose(values[0], values[1])
    changed = jax.tree.map(lambda leaf: leaf.at[1].add(1.0), critic)
    np.testing.assert_array_equal(networks.values(changed, obs)[0], values[0])


def test_forward_is_a_tanh_network_with_linear_output(nets):
    networks, policy, _ = nets
    obs = np.asarray(jax.random.uniform(jax.random.key(3), (7, 28)), np.float64)
    x = obs
    for i in range(3):
        layer = policy["mean"][f"Dense_{i}"]
        x = (np.tanh(x) if i else x) @ np.asarray(layer["kernel"], np.float64)
    mean, log_std = networks.distribution(policy, jnp.asarray(obs, jnp.float32))
    np.testing.assert_allclose(mean, x, atol=1e-5)  # float32 sums of 256 products
    assert log_std.shape == (2,)


def test_gaussian_goldens():
    with jax.enable_x64(True), jax.numpy_rank_promotion("raise"):
        mean, log_std = jnp.array([0.1, -0.2]), jnp.array([-0.5, -0.5])
        old_mean, old_log_std = jnp.zeros(2), jnp.array([-0.4, -0.6])
        new, old = (mean, log_std), (old_mean, old_log_std)
        assert abs(kl_divergence(*new, *old) - 0.0975968) < ROUNDED
        assert abs(kl_divergence(*old, *new) - 0.0880238) < ROUNDED
        action = jnp.array([0.5, -0.3])
        assert abs(log_prob(action, mean, log_std) + 1.0689310) < ROUNDED
        assert abs(entropy(log_std) - 1.8378771) < ROUNDED
        batch = jnp.tile(mean, (3, 1))
        assert kl_divergence(batch, log_std, batch, log_std).shape == (3,)


def test_sampled_actions_have_the_policy_s_moments():
    mean, log_std = jnp.tile(jnp.array([1.0, -2.0]), (40_000, 1)), jnp.array([0.0, -1])
    action = sample(jax.random.key(4), mean, log_std)
    # 5 sigmas of 40 000 samples
    np.testing.assert_allclose(action.mean(0), [1.0, -2.0], atol=0.025)
    np.testing.assert_allclose(action.std(0), np.exp([0.0, -1.0]), rtol=0.02)


@pytest.mark.parametrize("precision", ["tensorfloat32", "bfloat16"])
def test_critics_of_a_lower_precision_stay_close(precision):
    config = AgentConfig(hidden_sizes=(64, 64), critic_precision=precision)
    networks = make_networks(config, 36, 2)
    _, critic = jax.jit(networks.init)(jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (100, 36))
    exact, rough = networks.values(critic, obs), networks.values(critic, obs, precision)
    assert rough.dtype == exact.dtype
    np.testing.assert_allclose(rough, exact, atol=0.05)  # 8 bits of mantissa
    if precision == "bfloat16":
        assert np.abs(rough - exact).max() > 1e-4  # it is another precision


@pytest.mark.parametrize(
    ("precision", "expect"),
    [("float32", "HIGHEST"), ("tensorfloat32", "HIGH"), ("bfloat16", "bf16")],
)
def test_the_critics_own_steps_use_the_precision(precision, expect):
    """Forward and backward products of the hidden layers, by what is compiled."""
    config = AgentConfig(hidden_sizes=(8,), critic_precision=precision)
    networks = make_networks(config, 5, 2)
    _, critic = jax.jit(networks.init)(jax.random.key(0))

    def loss(critic, obs):
        with jax.default_matmul_precision("highest"):
            return networks.values(critic, obs, precision).sum()

    obs = jnp.ones((7, 5))
    text = jax.jit(jax.grad(loss)).lower(critic, obs).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line]
    wide = [line for line in products if "5" in line]  # those that see observations
    assert wide
    assert all(expect in line for line in wide)


def test_acting_and_judging_use_full_precision():
    """Also outside an update, where a GPU would round products by itself."""
    networks = make_networks(AgentConfig(hidden_sizes=(8,)), 5, 2)
    policy, critic = jax.jit(networks.init)(jax.random.key(0))
    for fn, params in ((networks.distribution, policy), (networks.values, critic)):
        text = jax.jit(fn).lower(params, jnp.ones((7, 5))).as_text()
        products = [line for line in text.splitlines() if "dot_general" in line]
        assert products
        assert all("HIGHEST" in line for line in products)
