"""Safety Gym's worlds in MuJoCo MJX."""

from autocost_jax.envs.env import Env, list_envs, make_env

__all__ = ["Env", "list_envs", "make_env"]
