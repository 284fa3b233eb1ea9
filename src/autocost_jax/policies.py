"""Saved policies: their files, loading them, and their scores for people."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.agents.base import Agent
from autocost_jax.arrays import load_arrays, unflatten
from autocost_jax.config import TrainConfig
from autocost_jax.envs.env import make_env
from autocost_jax.population import make_agents
from autocost_jax.records import EvalResult

EVALUATION = 2**31 - 1  # purpose of the final evaluation's key, beyond any stage


def require_episodes(num_episodes: int) -> None:
    """Refuse an evaluation without an episode before anything is trained."""
    if num_episodes < 1:
        raise ValueError(f"number of episodes must be >= 1, got {num_episodes}")


def policy_name(stage: int, algorithm: str) -> str:
    """File stem of the policy of a stage's best candidate."""
    return f"stage_{stage:02d}_{algorithm}"


def load_policies(train: TrainConfig, files: Sequence[Path]) -> tuple[Agent, Any]:
    """Saved policies as one stacked agent state, and the agent that acts for it.

    Args:
      train: the run's training configuration, for the shapes.
      files: policies/*.npz.

    Returns:
      Agent, and its state with the policies stacked [P, ...].

    Raises:
      RunDirError: a file is missing or is not such a policy.
    """
    # Whose policy it is does not matter: all agents act alike.
    (agent,) = make_agents(("ppo_lagrangian",), train, make_env(train.env))
    template = agent.init(jax.random.key(0))
    loaded = [unflatten(load_arrays(file, None), template.policy) for file in files]
    stacked = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (len(loaded), *leaf.shape)), template
    )
    policy = jax.tree.map(lambda *leaves: jnp.stack(leaves), *loaded)
    return agent, dataclasses.replace(stacked, policy=policy)


def eval_summary(result: EvalResult) -> dict[str, float | int]:
    """Means with normal 95 % intervals over the valid episodes of one policy."""
    valid = np.asarray(result.valid) > 0
    count = int(valid.sum())

    def interval(values: jax.Array) -> tuple[float, float]:
        kept = np.asarray(values, np.float64)[valid]
        if count < 2:
            return float(kept.mean()) if count else float("nan"), float("nan")
        return float(kept.mean()), float(1.96 * kept.std(ddof=1) / np.sqrt(count))

    ep_return, ep_cost = interval(result.ep_return), interval(result.ep_cost)
    return {
        "return_mean": ep_return[0],
        "return_ci": ep_return[1],
        "cost_mean": ep_cost[0],
        "cost_ci": ep_cost[1],
        "violation_rate": float(result.violation_rate),
        "distance_travelled": interval(result.distance_travelled)[0],
        "episodes": count,
    }


def score_line(label: str, row: dict[str, Any]) -> str:
    """One row of `eval_summary` for people."""
    return (
        f"{label}: return {row['return_mean']:.2f} +- {row['return_ci']:.2f}, "
        f"extrinsic cost {row['cost_mean']:.3f} +- {row['cost_ci']:.3f}, "
        f"violating episodes {row['violation_rate']:.1%} of {row['episodes']}"
    )
