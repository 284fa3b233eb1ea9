"""Methods x seeds trained together: a table of slots for the population program.

A method is an algorithm and a training cost; a figure of the paper is a table of them.
The run directory holds the configuration, metrics, checkpoints, the policy of every
slot and their scores over fresh episodes.
"""

import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from autocost_jax.agents.base import actor
from autocost_jax.config import Algorithm, AlgorithmName, TrainConfig
from autocost_jax.config.checks import (
    FINITE,
    SEED,
    Check,
    check_fields,
    is_distinct,
    is_finite,
    is_tuple_of,
    one_of,
    setting,
)
from autocost_jax.costs import parse_cost, training_cost
from autocost_jax.envs.env import Env, make_env
from autocost_jax.files import flatten
from autocost_jax.population import (
    Population,
    make_agents,
    make_evaluator,
    make_population,
    stack_slots,
)
from autocost_jax.records import Slot, root_key
from autocost_jax.runs import cluster
from autocost_jax.runs.directory import RunDir, open_run
from autocost_jax.runs.limits import (
    require_evaluation,
    require_memory,
    training_bytes,
)
from autocost_jax.runs.loop import (
    Chunk,
    compile_ahead,
    keep_chunks,
    metric_rows,
    output,
    start,
    useful_devices,
)
from autocost_jax.runs.policies import (
    EVALUATION,
    episodes_of,
    eval_summaries,
    load_policies,
    score_line,
)
from autocost_jax.runs.progress import Display, format_seconds
from autocost_jax.train import EpochState

GROUPS: tuple[Algorithm, ...] = get_args(Algorithm)
LABEL = Check(
    "the name of a file, of at most 100 characters and not with a dot first",
    lambda x: (
        isinstance(x, str)
        and bool(re.fullmatch(r"[^./\\\0-\x1f][^/\\\0-\x1f]{0,99}", x))
    ),
)
TERMS = Check("terms of the bank", lambda x: isinstance(x, str))
THETA = Check(
    "null or a tuple of finite numbers",
    lambda x: x is None or is_tuple_of(is_finite, x),
)
ROWS = Check(
    "a tuple of Methods, one at least",
    lambda x: is_tuple_of(lambda row: isinstance(row, Method), x) and x != (),
)
SEEDS = Check(
    "a tuple of distinct integers in [0, 2**32)",
    lambda x: is_tuple_of(SEED.holds, x) and x != () and is_distinct(x),
)


@dataclass(frozen=True)
class Method:
    """One row of the table.

    Attributes:
      label: its name in files and tables.
      algorithm: ppo, ppo_lagrangian, cpo, focops or pid_lagrangian.
      cost: the training cost, see `costs.training_cost`.
      limit: allowed training cost per episode.
      theta: the intrinsic network's parameters, if `cost` uses it.
    """

    label: str = setting(MISSING, LABEL, "its name in files and tables")
    algorithm: AlgorithmName = setting(
        "ppo_lagrangian", one_of(AlgorithmName), "that trains it"
    )
    cost: str = setting("extrinsic", TERMS, "the training cost")
    limit: float = setting(0.0, FINITE, "allowed training cost per episode")
    theta: tuple[float, ...] | None = setting(None, THETA, "of the intrinsic network")

    def __post_init__(self) -> None:
        check_fields(self)
        theta = None if self.theta is None else np.asarray(self.theta)
        parse_cost(self.cost, theta, self.limit)

    @property
    def group(self) -> Algorithm:
        """Whose slots it is among: PPO is a PPO-Lagrangian slot that ignores cost."""
        return "ppo_lagrangian" if self.algorithm == "ppo" else self.algorithm


@dataclass(frozen=True)
class SweepConfig:
    """What is trained: every method with every seed, side by side.

    Attributes:
      train: worlds, epochs and the learners' settings.
      methods: the rows; labels are distinct, networks of one size.
      seeds: one slot a method and seed.
    """

    train: TrainConfig = field(default_factory=TrainConfig)
    methods: tuple[Method, ...] = setting((), ROWS, "what is trained")
    seeds: tuple[int, ...] = setting((0,), SEEDS, "of each method")

    def __post_init__(self) -> None:
        check_fields(self)
        labels = [method.label for method in self.methods]
        if len(set(labels)) < len(labels):
            raise ValueError(f"methods must have distinct labels, got {labels}")
        sizes = {len(row.theta) for row in self.methods if row.theta is not None}
        if len(sizes) > 1:
            raise ValueError(
                "the methods of a table must have cost networks of one size, "
                f"got {sorted(sizes)} parameters"
            )

    def group(self, name: str) -> list[tuple[Method, int]]:
        """The slots of one algorithm group, in order."""
        return [
            (method, seed)
            for method in self.methods
            for seed in self.seeds
            if method.group == name
        ]

    @property
    def algorithms(self) -> tuple[Algorithm, ...]:
        """The groups that have slots."""
        return tuple(name for name in GROUPS if self.group(name))

    @property
    def env_steps(self) -> int:
        """Environment steps of the whole table."""
        epoch = self.train.num_worlds * self.train.env.num_steps
        slots = len(self.methods) * len(self.seeds)
        return slots * self.train.num_epochs * epoch


class SweepState(struct.PyTreeNode):
    """What a checkpoint holds.

    Attributes:
      training: of each group's slots [P].
      epoch: [] int32 epochs done.
    """

    training: EpochState
    epoch: jax.Array


def sweep_slots(config: SweepConfig) -> tuple[Slot, ...]:
    """The stacked slots of each group; the key of a slot is that of its seed."""
    thetas = [row.theta for row in config.methods if row.theta is not None]
    unused = np.zeros_like(thetas[0]) if thetas else None

    def slot(method: Method, seed: int) -> Slot:
        theta = unused if method.theta is None else np.asarray(method.theta)
        return Slot(
            cost=training_cost(method.cost, theta, method.limit),
            key=root_key(seed),
            constrained=jnp.asarray(method.algorithm != "ppo", jnp.float32),
        )

    return tuple(
        stack_slots([slot(method, seed) for method, seed in config.group(name)])
        for name in config.algorithms
    )


def run_sweep(
    config: SweepConfig,
    path: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    devices: Sequence[Any] | None = None,
    num_episodes: int | None = None,
) -> list[dict[str, Any]]:
    """Train and evaluate a table in a run directory, or resume it.

    Args:
      config: the table; on resume it must be the run's own, but for
        `config_files.MAY_DIFFER`.
      path: the run directory.
      resume: continue from the newest whole checkpoint.
      overwrite: start over in a directory that already holds a run.
      devices: default: the first one.
      num_episodes: fresh episodes a slot in the final evaluation; default: the run's
        own on resume, else 100.

    Returns:
      For each slot its method, seed and scores, as in evaluation.json; of several
      processes only the first has them, the others return an empty list.

    Raises:
      RunDirError: the directory is not usable for this run.
      DiskFullError: the disk is full; the directory is intact.
      Stopped: a signal to stop has come; see `keep_chunks`.
      ValueError: it does not fit the devices.
    """
    num_episodes = episodes_of(path, resume, num_episodes)
    slots = sweep_slots(config)
    sizes = [group.key.shape[0] for group in slots]
    devices = useful_devices(devices, max(sizes), "slots of an algorithm")
    env = make_env(config.train.env)
    need = training_bytes(config.train, env, sizes, len(devices))
    require_memory(need, "the training", devices)
    require_evaluation(env, sum(sizes), num_episodes, devices)
    agents = make_agents(config.algorithms, config.train, env)
    population = make_population(env, agents, config.train, devices=devices)
    how = {"resume": resume, "overwrite": overwrite, "num_episodes": num_episodes}
    opened = open_run(path, config, **how)
    with opened as run, Display(config.env_steps, 0, output()) as display:
        for line in run.warnings if run else ():
            display.say(line)
        display.say(
            f"{env.config.name}: {len(config.methods)} methods x {len(config.seeds)} "
            f"seeds, {config.env_steps:,} env steps on {len(devices)} device(s)"
        )
        state = SweepState(population.init(slots), jnp.zeros((), jnp.int32))
        state, resumed = start(run, path, state, display, resume)
        if resumed:
            display.say(f"resuming {path} after {int(state.epoch)} epochs")
        if int(state.epoch) < config.train.num_epochs:
            compile_ahead(population, state.training, slots, display)
        chunks = _chunks(config, population, slots, state, display)
        state = keep_chunks(run, path, chunks, state, population.fetch)
        table = []
        if run is not None:
            table = _finish(run, env, config, state, display, num_episodes)
        cluster.wait_for_all()
        return table


def _chunks(
    config: SweepConfig,
    population: Population,
    slots: tuple[Slot, ...],
    state: SweepState,
    display: Display,
) -> Iterator[Chunk]:
    """Train chunk after chunk, and show each."""
    chunk, total = config.train.chunk_epochs, config.train.num_epochs
    begun, first = time.monotonic(), int(state.epoch)
    training = state.training
    for epoch in range(first, total, chunk):
        after = epoch + chunk
        training, metrics = population.chunk(training, slots, epoch)
        metrics = jax.tree.map(np.asarray, population.fetch(metrics))
        left = (time.monotonic() - begun) / (after - first) * (total - after)
        named = zip(config.algorithms, metrics, strict=True)
        display.say(
            f"epoch {after}/{total}  "
            + "  ".join(_line(config, name, group) for name, group in named)
            + f"  time left {format_seconds(left)}"
        )
        rows = metric_rows(config.algorithms, metrics)
        yield Chunk(
            state=SweepState(training, jnp.asarray(after, jnp.int32)),
            first=epoch,
            rows=[row | {"epoch": epoch + k} for k, row in enumerate(rows)],
            position={},
            is_end=after >= total,
        )


def _line(config: SweepConfig, name: str, metrics: dict[str, np.ndarray]) -> str:
    """Return / cost of each method, means over its seeds."""
    cells: dict[str, list[int]] = {}
    for index, (method, _) in enumerate(config.group(name)):
        cells.setdefault(method.label, []).append(index)
    return "  ".join(
        f"{label} {metrics['ep_return'][-1, index].mean():.1f}/"
        f"{metrics['ep_cost'][-1, index].mean():.2f}"
        for label, index in cells.items()
    )


def _finish(
    run: RunDir,
    env: Env,
    config: SweepConfig,
    state: SweepState,
    display: Display,
    num_episodes: int,
) -> list[dict[str, Any]]:
    """Save every policy, score it over fresh episodes, write evaluation.json."""
    files, table = [], []
    learners = state.training.learners
    for i, name in enumerate(config.algorithms):
        actors = jax.tree.map(np.asarray, actor(learners[i].agent))
        for index, (method, seed) in enumerate(config.group(name)):
            params = jax.tree.map(lambda leaf, index=index: leaf[index], actors)
            stem = f"{method.label}_seed{seed}"
            files.append(run.write_policy(stem, flatten(params)))
            frozen = int(learners[i].frozen_epoch[index])
            row = {"method": method.label, "seed": seed, "frozen_epoch": frozen}
            table.append(row)
            if frozen >= 0:
                display.say(f"{stem} met a non-finite number in epoch {frozen}")
    agent, states = load_policies(env, config.train, files)
    key = root_key(EVALUATION)
    with display.working(
        f"evaluating {len(files)} policies over {num_episodes} episodes"
    ):
        evaluator = make_evaluator(env, agent, num_episodes)
        results, _ = jax.block_until_ready(evaluator(states, key))
    for row, scores in zip(table, eval_summaries(results), strict=True):
        row |= scores
    run.write_json("evaluation", {"episodes": num_episodes, "rows": table})
    for row in table:
        display.say("  " + score_line(f"{row['method']} seed {row['seed']}", row))
    display.say(f"done in {format_seconds(display.elapsed)}; see {run.path}")
    return table
