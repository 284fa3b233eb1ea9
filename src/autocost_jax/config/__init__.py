"""What a run is: frozen dataclasses that check themselves, and the named sizes."""

from autocost_jax.config.env import (
    ENVS,
    LIDAR_BINS,
    SUITE,
    EnvConfig,
    env_config,
)
from autocost_jax.config.presets import PRESETS, preset
from autocost_jax.config.training import (
    THETA_SIZES,
    AgentConfig,
    Algorithm,
    AlgorithmName,
    CostNetwork,
    Precision,
    SearchConfig,
    TrainConfig,
)

__all__ = [
    "ENVS",
    "LIDAR_BINS",
    "PRESETS",
    "SUITE",
    "THETA_SIZES",
    "AgentConfig",
    "Algorithm",
    "AlgorithmName",
    "CostNetwork",
    "EnvConfig",
    "Precision",
    "SearchConfig",
    "TrainConfig",
    "env_config",
    "preset",
]
