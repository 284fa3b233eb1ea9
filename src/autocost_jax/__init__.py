"""AutoCost in JAX: evolve intrinsic costs until agents stop violating constraints.

The public names; each is documented where it is defined. `python -m
autocost_jax.evolve` is the main job, `autocost --help` lists the other commands.
"""

from autocost_jax.agents.base import Agent, AgentState
from autocost_jax.agents.cpo import cpo
from autocost_jax.agents.focops import focops
from autocost_jax.agents.pid_lagrangian import pid_lagrangian
from autocost_jax.agents.ppo_lagrangian import ppo_lagrangian
from autocost_jax.config import (
    PRESETS,
    AgentConfig,
    EnvConfig,
    SearchConfig,
    TrainConfig,
    env_config,
    preset,
)
from autocost_jax.costs import (
    BANK,
    CostTerm,
    cost_card,
    intrinsic_cost,
    list_costs,
    load_cost,
    save_cost,
    total_cost,
    training_cost,
)
from autocost_jax.envs.env import Env, list_envs, make_env
from autocost_jax.es import (
    ES,
    Fitness,
    best,
    mutate,
    pool,
    rank,
    select,
    truncation_es,
)
from autocost_jax.evaluate import evaluate
from autocost_jax.evolve import evolve, search
from autocost_jax.population import make_population, stack_slots
from autocost_jax.records import (
    CostInputs,
    EnvState,
    EvalResult,
    Layout,
    PhysicsState,
    Slot,
    TrainingCost,
    Trajectory,
)
from autocost_jax.rollout import reset_worlds, unroll
from autocost_jax.search.starts import graded_start
from autocost_jax.train import run_stage, train

__all__ = [
    "BANK",
    "ES",
    "PRESETS",
    "Agent",
    "AgentConfig",
    "AgentState",
    "CostInputs",
    "CostTerm",
    "Env",
    "EnvConfig",
    "EnvState",
    "EvalResult",
    "Fitness",
    "Layout",
    "PhysicsState",
    "SearchConfig",
    "Slot",
    "TrainConfig",
    "TrainingCost",
    "Trajectory",
    "best",
    "cost_card",
    "cpo",
    "env_config",
    "evaluate",
    "evolve",
    "focops",
    "graded_start",
    "intrinsic_cost",
    "list_costs",
    "list_envs",
    "load_cost",
    "make_env",
    "make_population",
    "mutate",
    "pid_lagrangian",
    "pool",
    "ppo_lagrangian",
    "preset",
    "rank",
    "reset_worlds",
    "run_stage",
    "save_cost",
    "search",
    "select",
    "stack_slots",
    "total_cost",
    "train",
    "training_cost",
    "truncation_es",
    "unroll",
]
