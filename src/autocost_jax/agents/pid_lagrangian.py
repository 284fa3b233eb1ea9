"""PPO with a PID-controlled multiplier (Stooke et al. 2020, arXiv:2007.03964).

The multiplier of PPO-Lagrangian integrates the violation. Terms in proportion to the
violation and to the rise of the cost make it answer at once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from autocost_jax.agents.base import Agent, EnvSizes
from autocost_jax.agents.first_order import MultiplierRule
from autocost_jax.agents.ppo_lagrangian import ppo_agent
from autocost_jax.config import AgentConfig


class PidGains(NamedTuple):
    """Of costs per episode; the defaults are those of OmniSafe's CPPOPID.

    Attributes:
      proportional: gain of the smoothed violation.
      integral: gain of an epoch's violation in the sum over all.
      derivative: gain of the rise of the smoothed cost.
      smoothing: share of the last value in the moving averages.
      delay: epochs over which the cost rises.
      most: that the multiplier may be.
    """

    proportional: float = 0.1
    integral: float = 0.01
    derivative: float = 0.01
    smoothing: float = 0.95
    delay: int = 10
    most: float = 100.0


class PidMemory(NamedTuple):
    """What the controller remembers.

    Attributes:
      violation: [] moving average of J_c - d.
      integral: [] its weighted sum, never below 0.
      costs: [delay] moving average of J_c at the ends of the last epochs, oldest first.
    """

    violation: jax.Array
    integral: jax.Array
    costs: jax.Array


def pid_step(
    gains: PidGains, memory: PidMemory, j_c: jax.Array, limit: jax.Array
) -> tuple[PidMemory, jax.Array]:
    """The multiplier after an epoch.

        lambda = min(max(K_P e + I + K_D max(c - c_old, 0), 0), most)
        I <- max(I + K_I (J_c - d), 0)

    with e and c the moving averages of J_c - d and of J_c, which begin at 0, and c_old
    the latter `delay` epochs ago.

    Args:
      gains: of the controller.
      memory: of the epochs before.
      j_c: [] mean episode cost of this epoch.
      limit: [] allowed episode cost d.

    Returns:
      The memory, and lambda [].
    """
    old, new = gains.smoothing, 1.0 - gains.smoothing
    violation = old * memory.violation + new * (j_c - limit)
    integral = jnp.maximum(memory.integral + gains.integral * (j_c - limit), 0.0)
    cost = old * memory.costs[-1] + new * j_c
    rise = jnp.maximum(cost - memory.costs[0], 0.0)
    total = gains.proportional * violation + integral + gains.derivative * rise
    costs = jnp.append(memory.costs[1:], cost)
    multiplier = jnp.clip(total, 0.0, gains.most)
    return PidMemory(violation, integral, costs), multiplier


def pid_lagrangian(
    config: AgentConfig,
    env: EnvSizes,
    gains: PidGains = PidGains(),  # noqa: B008, a tuple of numbers
) -> Agent:
    """PPO with a cost term weighed by a PID controller of the episode cost.

    Args:
      config: hyper-parameters; those of the multiplier are not used.
      env: asked for its sizes only.
      gains: of the controller.

    Returns:
      The agent, with the metrics of `first_order_agent`.
    """

    def init() -> tuple[jax.Array, PidMemory]:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero, PidMemory(zero, zero, jnp.zeros(gains.delay, zero.dtype))

    def step(
        multiplier: jax.Array, memory: PidMemory, j_c: jax.Array, limit: jax.Array
    ) -> tuple[jax.Array, PidMemory, jax.Array]:
        del multiplier
        memory, multiplier = pid_step(gains, memory, j_c, limit)
        return multiplier, memory, multiplier

    return ppo_agent(config, env, MultiplierRule(init, step))
