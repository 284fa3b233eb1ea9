"""What a run needs of memory and disk, against what there is."""

import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from autocost_jax.config import TrainConfig
from autocost_jax.envs.env import Env
from autocost_jax.train import population_chunk

# What the kernel lets a container or a job have; "max" or a huge number: no limit.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def training_bytes(
    train: TrainConfig, env: Env, groups: Sequence[int], num_devices: int
) -> int:
    """Bytes that the largest arrays of a program need on each device, roughly.

    The trajectory of all slots, twice (the rollout writes it time-first, the updates
    read it slot-first), and four copies of parameters and optimiser moments.

    Args:
      train: sizes.
      env: the environment.
      groups: slots of each algorithm.
      num_devices: that share them.
    """
    agent = train.agent
    row = env.observation_size + 2 * env.action_size + 24
    rows = train.num_worlds * env.episode_length
    sizes = (env.observation_size, *agent.hidden_sizes, env.action_size)
    weights = sum(a * b for a, b in itertools.pairwise(sizes))
    batch = rows // agent.value_minibatches
    width = max(agent.hidden_sizes, default=0)
    activations = 4 * batch * width * len(agent.hidden_sizes)
    per_slot = 2 * row * rows + 4 * 3 * 3 * weights
    here = -(-sum(groups) // num_devices)
    at_once = population_chunk(train, -(-max(groups) // num_devices))
    return 4 * (per_slot * here + activations * at_once)


def require_evaluation(
    env: Env, num_policies: int, num_episodes: int, devices: Sequence[Any]
) -> None:
    """Refuse an evaluation whose rewards, costs and actions do not fit, side by side.

    Raises:
      ValueError: as `require_memory`.
    """
    floats = 3 + env.action_size
    need = 4 * floats * env.episode_length * num_policies * num_episodes
    require_memory(need, f"an evaluation over {num_episodes} episodes", devices)


def checkpoint_bytes(train: TrainConfig, env: Env, num_slots: int) -> int:
    """Bytes of four checkpoints (three are kept), which hold nearly all of a run."""
    hidden = train.agent.hidden_sizes
    networks = [(env.observation_size, *hidden, out) for out in (env.action_size, 1, 1)]
    weights = sum(
        (a + 1) * b for sizes in networks for a, b in itertools.pairwise(sizes)
    )
    return 4 * 4 * 3 * weights * num_slots  # float32 parameters and two Adam moments


def memory_of(devices: Sequence[Any]) -> int | None:
    """Bytes that each of the devices has, or this process may use; None: unknown."""
    if devices[0].platform != "cpu":
        stats = jax.local_devices()[0].memory_stats() or {}
        return stats.get("bytes_limit")
    limits = []
    if hasattr(os, "sysconf"):  # not on Windows
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for file in CGROUP_LIMITS:
        try:
            limits.append(int(file.read_text()))
        except (OSError, ValueError):
            continue
    # The devices of a CPU share the memory.
    return min(limits) // len(jax.local_devices()) if limits else None


def require_memory(need: int, what: str, devices: Sequence[Any]) -> None:
    """Refuse what cannot fit before anything is written.

    Args:
      need: bytes on each device.
      what: needs them.
      devices: it runs on.

    Raises:
      ValueError: with the estimate and what the device has, if it tells.
    """
    limit = memory_of(devices)
    if limit is not None and need > limit:
        raise ValueError(
            f"{what} needs about {need / 1e9:,.1f} GB on each device, which has "
            f"{limit / 1e9:.1f} GB: train or evaluate less at a time, or use more "
            "devices"
        )
