"""The PID controller of a multiplier, by hand and in an agent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import SMALL, Sizes, act, make_slot, make_trajectory

from autocost_jax.agents import pid_lagrangian
from autocost_jax.agents.pid_lagrangian import PidGains, PidMemory, pid_step

ROUNDING = 1e-6


def multipliers(gains, costs, limit):
    """After each epoch."""

    def epoch(memory, j_c):
        return pid_step(gains, memory, j_c, limit)

    zero = jnp.zeros(())
    start = PidMemory(zero, zero, jnp.zeros(gains.delay))
    return np.asarray(jax.lax.scan(epoch, start, jnp.asarray(costs))[1])


@pytest.mark.parametrize(
    ("gains", "costs", "limit", "expected"),
    [
        # In proportion to the violation, never below 0.
        (PidGains(2, 0, 0, 0, 1), (5.0, 3.0, 1.0), 2.0, (6.0, 2.0, 0.0)),
        # The integral grows with the violation and does not go below 0.
        (PidGains(0, 0.5, 0, 0, 1), (4.0, 4.0, 0.0, 0.0, 4.0), 2.0, (1, 2, 1, 0, 1)),
        # A rise counts, a fall does not; over two epochs.
        (PidGains(0, 0, 1, 0, 2), (1.0, 3.0, 7.0, 2.0), 0.0, (1.0, 3.0, 6.0, 0.0)),
        # Moving averages from 0.
        (PidGains(1, 0, 0, 0.75, 1), (4.0, 4.0), 0.0, (1.0, 1.75)),
        (PidGains(0, 0, 1, 0.75, 1), (4.0, 4.0), 0.0, (1.0, 0.75)),
        # Never above `most`.
        (PidGains(1, 1, 1, 0, 1, most=5.0), (4.0, 9.0), 0.0, (5.0, 5.0)),
    ],
)
def test_controller_by_hand(gains, costs, limit, expected):
    got = multipliers(gains, costs, limit)
    np.testing.assert_allclose(got, expected, atol=ROUNDING)


def test_defaults_against_a_loop():
    rng = np.random.default_rng(0)
    costs, gains = 30 * rng.random(25), PidGains()
    got = multipliers(gains, costs, 10.0)
    error = integral = smooth = 0.0
    history = [0.0] * gains.delay
    for epoch, j_c in enumerate(costs):
        error = 0.95 * error + 0.05 * (j_c - 10.0)
        integral = max(integral + 0.01 * (j_c - 10.0), 0.0)
        smooth = 0.95 * smooth + 0.05 * j_c
        rise = max(smooth - history[epoch], 0.0)
        history.append(smooth)
        expected = min(max(0.1 * error + integral + 0.01 * rise, 0.0), 100.0)
        assert got[epoch] == pytest.approx(expected, abs=1e-5)


def test_an_agent_is_weighed_by_the_controller():
    """The metrics tell; a slot that ignores cost has a multiplier of 0."""
    gains = PidGains(0.5, 0.0, 0.0, 0.0, 1)
    agent = pid_lagrangian(SMALL, Sizes(), gains)
    state = jax.jit(agent.init)(jax.random.key(0))
    obs, action = act(agent, state, jax.random.key(1))
    trajectory = make_trajectory(obs, action, action[..., 0])
    cost = jnp.maximum(action[..., 1], 0.0)
    update = jax.jit(agent.update)
    for constrained in (1.0, 0.0):
        slot = make_slot(1.0, constrained)
        new, metrics = update(state, trajectory, cost, slot, jax.random.key(2))
        expected = 0.5 * (cost.sum(0).mean() - 1.0)
        assert expected > 0
        np.testing.assert_allclose(new.multiplier, expected, rtol=1e-5)
        np.testing.assert_allclose(
            metrics["multiplier"], constrained * expected, rtol=1e-5
        )
