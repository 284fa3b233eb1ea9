import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from agent_toys import SMALL, Sizes, act, make_slot, make_trajectory

from autocost_jax.agents.ppo_lagrangian import (
    clipped_objective,
    policy_loss,
    ppo_lagrangian,
    update_multiplier,
)
from autocost_jax.config import AgentConfig

ROUNDED = 6e-8  # the goldens are printed with seven decimals
CONFIG = AgentConfig()


def multipliers(costs, limit):
    """The multiplier after each epoch, float64."""
    with jax.enable_x64(True):
        p = jnp.log(jnp.expm1(jnp.asarray(1.0)))
        opt_state = optax.adam(CONFIG.multiplier_lr).init(p)

        def epoch(carry, j_c):
            p, opt_state = carry
            d = jnp.asarray(limit)
            carry = update_multiplier(CONFIG, p, opt_state, j_c, d)
            return carry, jax.nn.softplus(carry[0])

        return np.asarray(jax.lax.scan(epoch, (p, opt_state), jnp.asarray(costs))[1])


@pytest.mark.parametrize(
    ("limit", "costs", "expect"),
    [
        (
            0.0,
            (30, 20, 10, 5, 0, 0, 0, 0),
            (
                1.0318954,
                1.0633934,
                1.0928714,
                1.1197265,
                1.1427015,
                1.1627035,
                1.1803217,
                1.1959683,
            ),
        ),
        (
            -0.1,
            (30, 20, 10, 5, 0, 0, 0, 0),
            (
                1.0318954,
                1.0633996,
                1.0929041,
                1.1198145,
                1.1428863,
                1.1630208,
                1.1808029,
                1.1966418,
            ),
        ),
        (
            25.0,
            (60, 40, 25, 10, 0, 0),
            (1.0318954, 1.0613888, 1.0845081, 1.0952015, 1.0934584, 1.0841142),
        ),
    ],
)
def test_multiplier_golden(limit, costs, expect):
    got = multipliers(np.asarray(costs, float), limit)
    np.testing.assert_allclose(got, expect, atol=ROUNDED)


EPOCHS = np.array([50, 100, 200, 333]) - 1
DECAY = 0.97 ** np.arange(333)


@pytest.mark.parametrize("violation", [1e-2, 7.0, 500.0])
def test_constant_violation_moves_the_multiplier_alike(violation):
    got = multipliers(np.full(333, violation), 0.0)[EPOCHS]
    np.testing.assert_allclose(got, (3.088, 5.545, 10.541, 17.191), atol=6e-4)
    np.testing.assert_allclose(got / (1 + got), (0.755, 0.847, 0.913, 0.945), atol=6e-4)


def test_decaying_violation_stalls_the_multiplier():
    got = multipliers(20 * DECAY, 0.0)
    np.testing.assert_allclose(got[EPOCHS], (2.643, 3.407, 3.693, 3.712), atol=6e-4)
    stopped = multipliers(np.where(np.arange(333) < 100, 20 * DECAY, 0.0), 0.0)
    np.testing.assert_allclose(stopped[EPOCHS[[1, 3]]], (3.407, 3.484), atol=6e-4)


@pytest.mark.parametrize(
    ("start", "limit", "expect"),
    [
        (20, 0, 3.71),
        (20, -0.1, 3.94),
        (20, -1, 5.82),
        (4, 0, 3.71),
        (4, -0.1, 4.82),
        (4, -1, 10.70),
    ],
)
def test_negative_limits(start, limit, expect):
    got = multipliers(start * DECAY, float(limit))[-1]
    assert got == pytest.approx(expect, abs=6e-3)


def test_multiplier_rises_iff_the_cost_exceeds_the_limit():
    for j_c, sign in ((3.0, 1), (1.0, -1), (2.0, 0)):
        moved = multipliers([j_c], 2.0)[0] - 1.0
        assert np.sign(np.round(moved, 12)) == sign


@pytest.mark.parametrize(
    ("ratio", "gain", "loss"),
    [(0.7, 0.7, -0.8), (0.95, 0.95, -0.95), (1.1, 1.1, -1.1), (1.3, 1.2, -1.3)],
)
def test_clip(ratio, gain, loss):
    got = clipped_objective(jnp.full(2, ratio), jnp.array([1.0, -1.0]), 0.2)
    np.testing.assert_allclose(got, (gain, loss), rtol=1e-6)


def test_loss_without_multiplier_is_exactly_ppo_s():
    rng = np.random.default_rng(0)
    rows = jnp.asarray(rng.normal(size=(64, 4)), jnp.float32).at[:, 3].set(1.0)
    new = rows[:, 0] + 0.1
    ratio = jnp.exp(new - rows[:, 0])
    plain = -jnp.mean(clipped_objective(ratio, rows[:, 1], 0.2))
    assert policy_loss(new, rows, jnp.asarray(0.0), 0.2) == plain
    half = policy_loss(new, rows, jnp.asarray(1.0), 0.2)
    expect = float(plain + jnp.mean(ratio * rows[:, 2])) / 2
    assert half == pytest.approx(expect, rel=1e-5)


def test_plain_ppo_ignores_cost_bit_for_bit():
    agent = ppo_lagrangian(SMALL, Sizes())
    state = jax.jit(agent.init)(jax.random.key(0))
    obs, action = act(agent, state, jax.random.key(1))
    trajectory = make_trajectory(obs, action, action[..., 0])
    update = jax.jit(agent.update)
    ends = [
        update(state, trajectory, cost, make_slot(0.0, 0.0), jax.random.key(2))
        for cost in (jnp.zeros_like(trajectory.reward), 5.0 * obs[:-1, :, 0])
    ]
    jax.tree.map(np.testing.assert_array_equal, ends[0][0].policy, ends[1][0].policy)
    assert ends[1][1]["multiplier"] == 0
    assert ends[1][1]["cost_weight"] == 0


@pytest.mark.parametrize("minibatches", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_kl_stop_takes_whole_passes_and_then_none(minibatches):
    """A step far beyond the trust region ends the update after one pass."""
    config = AgentConfig(
        hidden_sizes=(8,),
        policy_lr=0.5,
        policy_passes=5,
        policy_minibatches=minibatches,
        value_passes=1,
    )
    agent = ppo_lagrangian(config, Sizes())
    state = jax.jit(agent.init)(jax.random.key(0))
    obs, action = act(agent, state, jax.random.key(1))
    trajectory = make_trajectory(obs, action, action[..., 0])
    cost = jnp.zeros_like(trajectory.reward)
    new, metrics = jax.jit(agent.update)(
        state, trajectory, cost, make_slot(), jax.random.key(2)
    )
    assert metrics["kl"] > config.kl_stop_factor * config.target_kl
    assert metrics["policy_steps"] == minibatches
    assert new.policy_opt[0].count == minibatches
    gentle = AgentConfig(
        hidden_sizes=(8,),
        policy_lr=1e-6,
        policy_passes=5,
        policy_minibatches=minibatches,
        value_passes=1,
    )
    agent = ppo_lagrangian(gentle, Sizes())
    new, metrics = jax.jit(agent.update)(
        state, trajectory, cost, make_slot(), jax.random.key(2)
    )
    assert metrics["policy_steps"] == 5 * minibatches
    assert new.policy_opt[0].count == 5 * minibatches
