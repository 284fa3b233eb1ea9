"""Learners: pure functions of one slot, to be vmapped over slots."""

from autocost_jax.agents.base import Agent, AgentState
from autocost_jax.agents.cpo import cpo
from autocost_jax.agents.focops import focops
from autocost_jax.agents.pid_lagrangian import pid_lagrangian
from autocost_jax.agents.ppo_lagrangian import ppo_lagrangian

__all__ = [
    "Agent",
    "AgentState",
    "cpo",
    "focops",
    "pid_lagrangian",
    "ppo_lagrangian",
]
