"""What several experiments need: a command line, tables that continue, statistics."""

import argparse
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from autocost_jax.commandline import use_compile_cache, use_devices
from autocost_jax.config import AgentConfig
from autocost_jax.runs.config_files import first_difference
from autocost_jax.runs.directory import read_config
from autocost_jax.runs.sweep import SweepConfig, run_sweep

# The learner of what is trained at reduced scale: smaller networks than the paper's,
# minibatches in place of 80 full-batch steps, everything else as in the paper.
REDUCED = AgentConfig(
    hidden_sizes=(64, 64),
    policy_passes=6,
    policy_minibatches=8,
    value_passes=6,
    value_minibatches=8,
)


class Options(NamedTuple):
    """Where things go, and how much of them.

    Attributes:
      runs: directory of the run directories.
      results: directory of the JSON, tables and figures.
      only: what of the experiment's worlds or variants; empty for all.
      smoke: the smallest size at which every line of code runs.
    """

    runs: Path
    results: Path
    only: tuple[str, ...] = ()
    smoke: bool = False


def run_part(
    name: str,
    description: str | None,
    parts: Mapping[str, Callable[[Options], None]],
    choices: Iterable[str],
) -> None:
    """The command line of an experiment: one of its parts, on a device a core.

    Args:
      name: of its folders under runs/ and experiments/results/.
      description: what `--help` says.
      parts: what can be asked for.
      choices: what `--only` may name.
    """
    parser = part_parser(description, parts)
    parser.add_argument("--only", nargs="+", choices=choices, default=())
    args = parser.parse_args()
    runs = args.runs or Path(f"runs/{name}_smoke" if args.smoke else f"runs/{name}")
    where = runs / "results" if args.smoke else Path(f"experiments/results/{name}")
    options = Options(runs, args.results or where, tuple(args.only), args.smoke)
    use_machine()
    parts[args.part](options)


def part_parser(
    description: str | None, parts: Iterable[str]
) -> argparse.ArgumentParser:
    """The flags of every experiment: its part, its size, its folders."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=tuple(parts))
    parser.add_argument("--smoke", action="store_true", help="a minute, no result")
    parser.add_argument("--runs", type=Path, help="of run directories, below runs/")
    parser.add_argument("--results", type=Path, help="of JSON, tables and figures")
    return parser


def use_machine() -> None:
    """A device a core and the compile cache, before anything of JAX runs."""
    use_compile_cache(True)
    use_devices(None)


def run_if_needed(config: SweepConfig, path: Path, num_episodes: int) -> None:
    """Train a table unless that is done; continue where it was stopped.

    Raises:
      SystemExit: the directory holds another table, such as one of an older cost.
    """
    if (path / "config.yaml").exists():
        check_same(config, path)
    if (path / "evaluation.json").exists():
        return
    resume = (path / "config.yaml").exists()
    devices = jax.devices()
    run_sweep(config, path, resume=resume, devices=devices, num_episodes=num_episodes)


def check_same(config: SweepConfig, path: Path) -> None:
    """End the program if a run directory is not that of a table."""
    difference = first_difference(read_config(path, SweepConfig)[0], config)
    if difference is not None:
        name, old, new = difference
        raise SystemExit(f"{path} has {name}={old}, wanted {name}={new}: remove it")


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
