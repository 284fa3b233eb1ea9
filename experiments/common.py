"""What several experiments need: tables that continue, statistics, compact JSON."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from autocost_jax.methods import TableConfig, run_table


def run_if_needed(config: TableConfig, path: Path, num_episodes: int) -> None:
    """Train a table unless that is done; continue where it was stopped."""
    if (path / "evaluation.json").exists():
        return
    resume = (path / "config.yaml").exists()
    devices = jax.devices()
    run_table(config, path, resume=resume, devices=devices, num_episodes=num_episodes)


def t_interval(values: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """Mean of one value a seed with its 95 % t-interval; NaN for a single seed."""
    from scipy.stats import t

    values = np.asarray(values, np.float64)
    count = values.size
    if count < 2:
        return {"mean": float(values.mean()), "low": np.nan, "high": np.nan}
    half = t.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count)
    mean = float(values.mean())
    return {"mean": mean, "low": float(mean - half), "high": float(mean + half)}


def compact(value: Any) -> str:
    """JSON with one line for each innermost list."""
    text = json.dumps(value, indent=1, allow_nan=False)
    return re.sub(
        r"\[[^\[\]{}]*\]", lambda match: " ".join(match.group().split()), text
    )
