"""The named sizes of a search: laptop, search, paper, smoke."""

import dataclasses
from typing import Any

from autocost_jax.config.env import EnvConfig
from autocost_jax.config.training import AgentConfig, SearchConfig, TrainConfig

_LAPTOP_AGENT = AgentConfig(
    normalize_obs=True,
    hidden_sizes=(32, 32),
    policy_output_scale=0.01,
    gae_lambda=0.95,
    cost_gae_lambda=0.95,
    target_kl=0.03,
    policy_passes=4,
    policy_minibatches=8,
    value_passes=3,
    value_minibatches=8,
    multiplier_init=1.0,
    multiplier_lr=0.01,
    cg_iterations=5,
    violation_factor=1.6,
)

# Few stages and more finalists (one short training says little of a cost that is near
# success, `experiments/starts.py`), a start among costs of which many are useful, mild
# mutations, and what a user asks for as the measure.
_GUIDED: dict[str, Any] = {
    "start": "graded",
    "init_std": 8.0,
    "mutation_std": 0.1,
    "mutation_low": 0.97,
    "mutation_high": 1.03,
    "references": True,
    "judge_by": "success",
    "pool_scores": True,
}

PRESETS: dict[str, SearchConfig] = {
    "laptop": SearchConfig(
        train=TrainConfig(
            env=EnvConfig(physics="closed_form"),
            agent=_LAPTOP_AGENT,
            num_worlds=8,
            num_epochs=24,
            chunk_epochs=2,
        ),
        population_size=19,
        num_elites=3,
        num_stages=2,
        fitness_epochs=8,
        num_finalists=5,
        final_epochs=120,
        **_GUIDED,
    ),
    "search": SearchConfig(
        train=TrainConfig(
            env=EnvConfig(physics="closed_form"),
            agent=_LAPTOP_AGENT,
            num_worlds=8,
            num_epochs=64,
            chunk_epochs=4,
        ),
        num_stages=4,
        fitness_epochs=16,
        seeds_per_candidate=3,
        num_finalists=10,
        final_seeds=5,
        final_epochs=256,
        **_GUIDED,
    ),
    "paper": SearchConfig(train=TrainConfig(chunk_epochs=3)),
    "smoke": SearchConfig(
        train=TrainConfig(
            env=EnvConfig(num_steps=50, physics="closed_form"),
            agent=dataclasses.replace(
                _LAPTOP_AGENT,
                hidden_sizes=(16, 16),
                policy_passes=2,
                value_passes=2,
                policy_minibatches=2,
                value_minibatches=2,
            ),
            num_worlds=2,
            num_epochs=2,
        ),
        population_size=4,
        num_elites=1,
        num_stages=2,
        fitness_epochs=1,
        num_finalists=1,
        final_seeds=2,
        **_GUIDED,
    ),
}
"""The named sizes of a search, by their names."""


def preset(name: str) -> SearchConfig:
    """A named `SearchConfig`.

    Raises:
      ValueError: if there is no such preset; the message lists those that exist.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}; presets: {', '.join(PRESETS)}")
    return PRESETS[name]
