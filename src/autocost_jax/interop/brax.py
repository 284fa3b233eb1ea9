"""Our environments as Brax environments, so that Brax's trainers run on them."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env as BraxEnvBase
from brax.envs.base import State

from autocost_jax.envs.env import Env
from autocost_jax.records import EnvState


class BraxEnv(BraxEnvBase):
    """An `Env` with the face of `brax.envs.base.Env`.

    `done` ends an episode at the time limit, and `state.info["cost"]` is the extrinsic
    cost of the step. Brax's auto-reset wrapper brings back the first layout of every
    world; Safety Gym draws a new one, as `autocost_jax.rollout.reset_worlds` does.

    Attributes:
      env: the environment underneath.
    """

    def __init__(self, env: Env) -> None:
        self.env = env

    def reset(self, rng: jax.Array) -> State:
        """A fresh episode; `rng` may be a raw or a typed key."""
        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        return self._wrap(self.env.reset(rng), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step."""
        inner: Any = state.pipeline_state
        return self._wrap(self.env.step(inner, action), state.info, state.metrics)

    def _wrap(
        self, inner: EnvState, info: dict[str, Any], metrics: dict[str, Any]
    ) -> State:
        counters = {
            name: value.astype(jnp.float32) for name, value in inner.metrics.items()
        }
        return State(
            pipeline_state=inner,  # pyright: ignore[reportArgumentType]
            obs=inner.obs,
            reward=inner.reward,
            done=inner.done.astype(inner.reward.dtype),
            metrics=metrics | counters | {"cost": inner.cost},
            info=info | {"cost": inner.cost},
        )

    @property
    def observation_size(self) -> int:
        """O."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """U."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """The physics engine."""
        return "mjx"
