"""FOCOPS: its loss by hand, its weight of the cost, and what it learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import SMALL, Sizes, act, make_slot, make_trajectory

from autocost_jax.agents import focops
from autocost_jax.agents.focops import FocopsSettings, focops_loss

NEAR, TEMPERATURE = 0.02, 1.5


def loss_of(kl, log_ratio, advantage, weight=(1.0, 1.0)):
    kl, log_ratio, advantage, weight = (
        jnp.asarray(x, jnp.float32) for x in (kl, log_ratio, advantage, weight)
    )
    return focops_loss(kl, log_ratio, advantage, weight, NEAR, TEMPERATURE)


@pytest.mark.parametrize(
    ("kl", "weight", "expected"),
    [
        # mean of 0.01 - 1.1 x 3 / 1.5 and 0.02 - 0.9 x -1.5 / 1.5
        ((0.01, 0.02), (1, 1), (0.01 - 2.2 + 0.02 + 0.9) / 2),
        ((0.01, 0.021), (1, 1), (0.01 - 2.2) / 2),  # too far: counts with 0
        ((0.01, 0.02), (1, 0), 0.01 - 2.2),  # not valid: does not count
    ],
)
def test_loss_by_hand(kl, weight, expected):
    log_ratio = np.log([1.1, 0.9])
    got = loss_of(kl, log_ratio, (3.0, -1.5), weight)
    assert float(got) == pytest.approx(expected, rel=1e-5)


def test_what_is_too_far_has_no_gradient():
    """Even where the ratio is infinite."""
    gradient = jax.grad(lambda x: loss_of(0.01 + 0 * x, x, (3.0, 3.0)).sum())
    far = jax.grad(lambda x: loss_of(1.0 + x, 1e9 * x, (3.0, 3.0)).sum())
    near = gradient(jnp.zeros(2))
    np.testing.assert_allclose(near, np.full(2, -3.0 / 1.5 / 2), rtol=1e-6)
    np.testing.assert_array_equal(far(jnp.ones(2)), np.zeros(2))


@pytest.fixture(scope="module")
def problem():
    """An update of an agent, and a trajectory whose costs sum to more than 1."""
    agent = focops(SMALL, Sizes(), FocopsSettings(nu_lr=0.5, nu_max=1.2))
    state = jax.jit(agent.init)(jax.random.key(0))
    obs, action = act(agent, state, jax.random.key(1))
    trajectory = make_trajectory(obs, action, action[..., 0])
    return state, trajectory, jnp.maximum(action[..., 1], 0.0), jax.jit(agent.update)


def test_the_weight_of_the_cost_climbs_and_is_bounded(problem):
    state, trajectory, cost, update = problem
    j_c = float(cost.sum(0).mean())
    expected = 0.0
    for limit in (j_c - 1.0, j_c - 1.0, j_c - 1.0, j_c + 1.0, j_c + 9.0):
        new, metrics = update(
            state, trajectory, cost, make_slot(limit), jax.random.key(2)
        )
        expected = float(np.clip(expected + 0.5 * (j_c - limit), 0.0, 1.2))
        assert float(new.multiplier) == pytest.approx(expected, abs=1e-5)
        assert float(metrics["multiplier"]) == pytest.approx(expected, abs=1e-5)
        state = state.replace(multiplier=new.multiplier)


def test_it_learns_reward_and_avoids_cost(problem):
    """Reward is the first action, cost the second: means move towards and away."""
    state, trajectory, cost, update = problem
    obs = trajectory.obs[:-1]

    def mean_action(state):
        agent = focops(SMALL, Sizes())
        return agent.policy(state, obs, jax.random.key(3), deterministic=True)

    before = mean_action(state).mean((0, 1))
    for seed in range(15):
        slot = make_slot(0.0)
        state, metrics = update(state, trajectory, cost, slot, jax.random.key(seed))
        assert metrics["kl"] < 0.1
    after = mean_action(state).mean((0, 1))
    assert after[0] > before[0]
    assert after[1] < before[1]


def test_a_slot_that_ignores_cost_is_the_same_without_any(problem):
    state, trajectory, cost, update = problem
    ends = [
        update(state, trajectory, each, make_slot(0.0, 0.0), jax.random.key(2))[0]
        for each in (cost, jnp.zeros_like(cost))
    ]
    jax.tree.map(np.testing.assert_array_equal, ends[0].policy, ends[1].policy)
