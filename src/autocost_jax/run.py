"""One search in a run directory: watched, checkpointed, resumed, reported."""

import io
import itertools
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax import cluster
from autocost_jax.agents.base import actor
from autocost_jax.arrays import flatten
from autocost_jax.config import SearchConfig
from autocost_jax.envs.env import make_env
from autocost_jax.evolution import (
    Progress,
    Searcher,
    SearchState,
    evolve,
    init_search,
    make_searcher,
    require_survivors,
    slots_of,
)
from autocost_jax.finish import finish
from autocost_jax.policies import (
    policy_name,
    require_episodes,
)
from autocost_jax.progress import Display, stage_lines, summarise
from autocost_jax.stages import StageResult
from autocost_jax.store import (
    RunDir,
    SilentRun,
    check_free_space,
    estimate_bytes,
    open_run,
)
from autocost_jax.train import slots_at_once

CHECKPOINT_SECONDS = 15.0  # at least, between two checkpoints within a stage


def estimate_memory(config: SearchConfig, num_devices: int) -> int:
    """Bytes the largest arrays of the program need on each device, roughly.

    The trajectory of all slots, twice (the rollout writes it time-first, the updates
    read it slot-first), and four copies of parameters and optimiser moments.
    """
    env = make_env(config.train.env)
    slots = config.slots_per_algorithm * len(config.algorithms)
    row = env.observation_size + 2 * env.action_size + 24
    rows = config.train.num_worlds * env.episode_length
    sizes = (env.observation_size, *config.train.agent.hidden_sizes, env.action_size)
    weights = sum(a * b for a, b in itertools.pairwise(sizes))
    width = max(config.train.agent.hidden_sizes, default=0)
    batch = rows // config.train.agent.value_minibatches
    activations = 4 * batch * width * len(config.train.agent.hidden_sizes)
    per_slot = 2 * row * rows + 4 * 3 * 3 * weights
    here = -(-slots // num_devices)
    at_once = slots_at_once(config.train, -(-config.slots_per_algorithm // num_devices))
    return 4 * (per_slot * here + activations * at_once)


def estimate_disk(config: SearchConfig) -> int:
    """Bytes of four checkpoints (three are kept), which hold nearly all of a run."""
    env = make_env(config.train.env)
    hidden = config.train.agent.hidden_sizes
    networks = [(env.observation_size, *hidden, out) for out in (env.action_size, 1, 1)]
    weights = sum(
        (a + 1) * b for sizes in networks for a, b in itertools.pairwise(sizes)
    )
    slots = config.slots_per_algorithm * len(config.algorithms)
    return 4 * 4 * 3 * weights * slots  # float32 parameters and two Adam moments


def describe(config: SearchConfig, num_devices: int) -> list[str]:
    """What a run will do, as lines for people."""
    train, agent = config.train, config.train.agent
    algorithms = " + ".join(config.algorithms)
    worlds = f"{train.num_worlds} worlds x {train.env.num_steps} steps"
    if train.segments_per_episode > 1:
        worlds += f" in {train.segments_per_episode} cohorts"
    sizes = "-".join(str(size) for size in agent.hidden_sizes)
    beside = ", beside the extrinsic cost alone and a margin of 3x"
    lines = [
        f"{train.env.name}: {config.num_stages} stages of {config.population_size} "
        f"candidates ({config.num_elites} elites) x {config.seeds_per_candidate} "
        f"seed(s), each trained by {algorithms}{beside * config.references}",
        f"{train.num_epochs} epochs of {worlds} a slot, nets {sizes}, policy "
        f"{agent.policy_passes} x {agent.policy_minibatches} and critic "
        f"{agent.value_passes} x {agent.value_minibatches} steps an epoch",
        f"{config.env_steps:,} env steps in all; on {num_devices} device(s) of kind "
        f"{jax.devices()[0].device_kind}; about "
        f"{estimate_memory(config, num_devices) / 1e9:.2f} GB of memory on each and "
        f"{estimate_disk(config) / 1e6:.0f} MB of disk; the time left is shown as "
        "soon as the first epoch is done",
    ]
    if config.num_finalists:
        lines.insert(
            1,
            f"then {config.num_finalists} finalists x {config.final_seeds} fresh seeds "
            f"for {config.epochs_of(config.num_stages)} epochs",
        )
    return lines


def check_memory(config: SearchConfig, devices: Sequence[Any]) -> None:
    """Refuse a run whose arrays cannot fit on its devices.

    Raises:
      ValueError: with the estimate and what the device has, if it tells.
    """
    stats = jax.local_devices()[0].memory_stats() or {}
    limit = stats.get("bytes_limit")
    if devices[0].platform == "cpu":  # its devices share the machine's memory
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        limit = machine // len(jax.local_devices())
    need = estimate_memory(config, len(devices))
    if limit is not None and need > limit:
        raise ValueError(
            f"the run needs about {need / 1e9:.1f} GB on each device, which has "
            f"{limit / 1e9:.1f} GB: set population_chunk, lower population_size or "
            "num_worlds, or use more devices"
        )


def run_search(
    config: SearchConfig,
    path: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    devices: Sequence[Any] | None = None,
    num_episodes: int = 100,
    planned: float | None = None,
) -> Path:
    """Run or resume a search and leave everything about it in a run directory.

    Args:
      config: the search; on resume it must be the run's own, but for
        `rundata.MAY_DIFFER`.
      path: the run directory.
      resume: continue from the newest whole checkpoint.
      overwrite: start over in a directory that already holds a run.
      devices: default: the first one.
      num_episodes: episodes of the final evaluation, of each agent.
      planned: seconds that it is meant to take; a slower machine is told so.

    Returns:
      The path of the report.

    Raises:
      RunDirError: the directory is not usable for this run.
      DiskFullError: the disk is full; the directory is intact.
      ValueError: the configuration does not fit the devices.
      RuntimeError: every candidate of a stage failed.
    """
    require_episodes(num_episodes)
    devices = useful_devices(devices, config.slots_per_algorithm, "slots")
    check_memory(config, devices)
    searcher = make_searcher(config, devices)
    run = open_run(path, config, resume=resume, overwrite=overwrite)
    with run, Display(config.env_steps, 0, output(), planned) as display:
        for line in [*run.warnings, *describe(config, len(devices))]:
            display.say(line)
        state = _start(run, searcher, display, resume)
        if int(state.stage) < config.total_stages:
            _compile(searcher, state, display)
        state = _train(run, searcher, state, display)
        state = state.replace(learners=searcher.population.fetch(state.learners))
        if isinstance(run, RunDir):
            finish(run, searcher.root, state, display, num_episodes)
        cluster.wait_for_all()
        return path / "report" / "index.html"


def useful_devices(
    devices: Sequence[Any] | None, num_slots: int, what: str
) -> list[Any]:
    """Devices that have a slot of their own; more would only train copies.

    Args:
      devices: those that may be used; default: the first one.
      num_slots: of the largest group.
      what: the slots are called in an error.

    Raises:
      ValueError: if some process would be without a slot.
    """
    chosen = list(devices or jax.devices()[:1])[:num_slots]
    if len({device.process_index for device in chosen}) < jax.process_count():
        raise ValueError(
            f"{jax.process_count()} processes are more than the {num_slots} {what} "
            "can be dealt to"
        )
    return chosen


def output() -> TextIO:
    """Where this process prints: of several only the first does."""
    return sys.stdout if cluster.is_first() else io.StringIO()


def resumed(
    run: RunDir | SilentRun, template: Any, display: Display
) -> tuple[Any, int | None]:
    """The state of the newest checkpoint, in every process, and its step.

    None, None where there is none yet; the step is known to the first process alone.
    """
    checkpoint = run.resume(template)
    found = cluster.share(checkpoint and checkpoint.tree, template)
    if found is None:
        display.say(f"{run.path} has no checkpoint yet: starting again")
    for line in checkpoint.warnings if checkpoint else ():
        display.say(line)
    return found, checkpoint.step if checkpoint else None


def _start(
    run: RunDir | SilentRun, searcher: Searcher, display: Display, resume: bool
) -> SearchState:
    state = init_search(searcher)
    if cluster.is_first():
        check_free_space(run.path, 4 * estimate_bytes(state))
    step = None
    if resume:
        found, step = resumed(run, state, display)
        if found is not None:
            state = found
            done = f"{int(state.stage)} stages and {int(state.epoch)} epochs"
            display.say(f"resuming {run.path} after {done}")
            display.skip(_steps_done(run.config, state))
            require_survivors(run.config, state.es)  # before anything is compiled
    hint = run.start_tensorboard(purge_step=step)
    if hint:
        display.say(hint)
    return state


def _compile(searcher: Searcher, state: SearchState, display: Display) -> None:
    start = time.monotonic()
    slots = slots_of(searcher, state)
    with display.working("compiling the population program"):
        searcher.population.compile(state.learners, slots)
    display.say(f"compiled in {time.monotonic() - start:.1f} s")


def _steps_done(config: SearchConfig, state: SearchState) -> int:
    stage = int(state.stage)
    epochs = sum(config.epochs_of(before) for before in range(stage))
    if stage < config.total_stages:
        epochs += int(state.epoch)
    return epochs * config.epoch_env_steps


def _train(
    run: RunDir | SilentRun, searcher: Searcher, state: SearchState, display: Display
) -> SearchState:
    config = run.config
    chunk = config.train.chunk_epochs
    saved_at = -np.inf  # the first chunk is kept, whatever comes
    display.start_clock()
    for after, progress in evolve(config, state=state, searcher=searcher):
        state = after
        first = progress.stage * config.train.num_epochs + progress.epoch
        display.update(
            summarise(config, progress.stage, progress.epoch + chunk, progress.metrics),
            config.epoch_env_steps * chunk,
        )
        for k in range(chunk):
            row: dict[str, Any] = {"stage": progress.stage, "epoch": progress.epoch + k}
            for name, group in zip(config.algorithms, progress.metrics, strict=True):
                row |= {f"{name}/{key}": value[k] for key, value in group.items()}
            row["time/env_steps_per_second"] = display.steps_per_second
            run.log_metrics(row, first + k)
        if progress.result is not None:
            _write_stage(run, searcher, state, progress, progress.result)
            for line in stage_lines(config, progress.stage, progress.result):
                display.say(line)
        is_due = time.monotonic() - saved_at >= CHECKPOINT_SECONDS
        is_due |= int(state.stage) > progress.stage  # the end of a stage
        if is_due or jax.process_count() > 1:  # clocks differ, and all must take part
            position = {"stage": int(state.stage), "epoch": int(state.epoch)}
            saved = state.replace(learners=searcher.population.fetch(state.learners))
            run.save_checkpoint(saved, first + chunk, position)
            saved_at = time.monotonic()
    return state


def _write_stage(
    run: RunDir | SilentRun,
    searcher: Searcher,
    state: SearchState,
    progress: Progress,
    result: StageResult,
) -> None:
    """The stage's npz and the policies of its best candidate."""
    config = run.config
    scores = {f"scores/{key}": value for key, value in result.scores.items()}
    scores |= {f"references/{key}": x for key, x in result.references.items()}
    arrays = {
        "theta": result.candidates,
        "cost": jnp.where(
            result.frozen.any(0), jnp.inf, result.scores["ep_cost"].mean(0)
        ),
        "judged": result.fitness.cost,
        "ep_return": result.fitness.ep_return,
        "order": result.order,
        "frozen": result.frozen,
        "elites": state.es.elites,
        "archive": state.es.archive,
        "archive_cost": state.es.archive_fitness.cost,
        "archive_return": state.es.archive_fitness.ep_return,
        "key": jax.random.key_data(searcher.root),
        **scores,
    }
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    run.write_stage(progress.stage, arrays)
    if not np.asarray(result.fitness.finite).any():
        return  # no candidate is the best
    top = int(result.order[0]) * config.seeds_per_candidate  # its first seed
    for name, learner in zip(config.algorithms, progress.learners, strict=True):
        policies = searcher.population.fetch(actor(learner.agent))
        params = jax.tree.map(lambda leaf: leaf[top], policies)
        run.write_policy(policy_name(progress.stage, name), flatten(params))
