"""Learners: pure functions of one slot, to be vmapped over slots."""

from autocost_jax.agents.base import Agent, AgentState
from autocost_jax.agents.cpo import cpo
from autocost_jax.agents.ppo_lagrangian import ppo_lagrangian

__all__ = ["Agent", "AgentState", "cpo", "ppo_lagrangian"]
