"""One search in a run directory: watched, checkpointed, resumed, reported."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.agents.base import actor
from autocost_jax.config import SearchConfig
from autocost_jax.envs.env import Env, make_env
from autocost_jax.files import flatten
from autocost_jax.runs import cluster
from autocost_jax.runs.directory import RunDir, open_run
from autocost_jax.runs.finish import finish
from autocost_jax.runs.limits import (
    checkpoint_bytes,
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
from autocost_jax.runs.policies import episodes_of, policy_name
from autocost_jax.runs.progress import (
    Display,
    format_seconds,
    stage_lines,
    summarise,
)
from autocost_jax.search.evolution import (
    Progress,
    Searcher,
    SearchState,
    evolve,
    init_search,
    make_searcher,
    require_survivors,
    slots_of,
)
from autocost_jax.search.stages import TRACKED, StageResult


def describe(config: SearchConfig, env: Env, num_devices: int) -> list[str]:
    """What a run will do, as lines for people."""
    train, agent = config.train, config.train.agent
    algorithms = " + ".join(config.algorithms)
    worlds = f"{train.num_worlds} worlds x {train.env.num_steps} steps"
    if train.segments_per_episode > 1:
        worlds += f" in {train.segments_per_episode} cohorts"
    sizes = "-".join(str(size) for size in agent.hidden_sizes)
    groups = _groups(config)
    memory = training_bytes(train, env, groups, num_devices) / 1e9
    disk = checkpoint_bytes(train, env, sum(groups)) / 1e6
    beside = ", beside the extrinsic cost alone and a margin of 3x"
    lines = [
        f"{train.env.name}: {config.num_stages} stages of {config.population_size} "
        f"candidates ({config.num_elites} elites) x {config.seeds_per_candidate} "
        f"seed(s), each trained by {algorithms}{beside * config.references}",
        f"{train.num_epochs} epochs of {worlds} a slot, nets {sizes}, policy "
        f"{agent.policy_passes} x {agent.policy_minibatches} and critic "
        f"{agent.value_passes} x {agent.value_minibatches} steps an epoch",
        f"{config.env_steps:,} env steps in all; on {num_devices} device(s) of kind "
        f"{jax.devices()[0].device_kind}; about {memory:.2f} GB of memory on each and "
        f"{disk:.0f} MB of disk; the time left is shown as "
        "soon as the first epoch is done",
    ]
    if config.num_finalists:
        lines.insert(
            1,
            f"then {config.num_finalists} finalists x {config.final_seeds} fresh seeds "
            f"for {config.epochs_of(config.num_stages)} epochs",
        )
    return lines


def _groups(config: SearchConfig) -> list[int]:
    """Slots of each algorithm."""
    return [config.slots_per_algorithm] * len(config.algorithms)


def plan(config: SearchConfig, path: Path, num_devices: int) -> str:
    """What a run in `path` would do; nothing is made there."""
    lines = describe(config, make_env(config.train.env), num_devices)
    return "\n".join([*lines, f"would write to {path}"])


def check_memory(
    config: SearchConfig, env: Env, devices: Sequence[Any], num_episodes: int
) -> None:
    """Refuse a run whose arrays cannot fit on its devices.

    Raises:
      ValueError: with the estimate and what the device has, if it tells.
    """
    groups = _groups(config)
    need = training_bytes(config.train, env, groups, len(devices))
    epochs = max(map(config.epochs_of, range(config.total_stages)))
    need += 4 * len(TRACKED) * epochs * sum(groups)
    require_memory(need, "the search", devices)
    costs = 1 + config.num_references  # an agent of each is scored at once
    require_evaluation(env, costs, num_episodes, devices)


def run_search(
    config: SearchConfig,
    path: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    devices: Sequence[Any] | None = None,
    num_episodes: int | None = None,
    planned: float | None = None,
    write_report: Callable[[Path], Path] | None = None,
) -> None:
    """Run or resume a search and leave everything about it in a run directory.

    Args:
      config: the search; on resume it must be the run's own, but for
        `config_files.MAY_DIFFER`.
      path: the run directory.
      resume: continue from the newest whole checkpoint.
      overwrite: start over in a directory that already holds a run.
      devices: default: the first one.
      num_episodes: of the final evaluation, of each agent; default: the run's own on
        resume, else 100.
      planned: seconds that it is meant to take; a slower machine is told so.
      write_report: run directory -> its report; default: none is written.

    Raises:
      RunDirError: the directory is not usable for this run.
      DiskFullError: the disk is full; the directory is intact.
      Stopped: a signal to stop has come; see `keep_chunks`.
      ValueError: the configuration does not fit the devices.
      RuntimeError: every candidate of a stage failed.
    """
    num_episodes = episodes_of(path, resume, num_episodes)
    devices = useful_devices(devices, config.slots_per_algorithm, "slots")
    searcher = make_searcher(config, devices)
    check_memory(config, searcher.env, devices, num_episodes)
    how = {"resume": resume, "overwrite": overwrite, "num_episodes": num_episodes}
    opened = open_run(path, config, **how)
    with opened as run, Display(config.env_steps, 0, output(), planned) as display:
        warnings = run.warnings if run else []
        for line in [*warnings, *describe(config, searcher.env, len(devices))]:
            display.say(line)
        damages: list[str] = []
        state, resumed = start(run, path, init_search(searcher), display, resume)
        if resumed:
            done = f"{int(state.stage)} stages and {int(state.epoch)} epochs"
            display.say(f"resuming {path} after {done}")
            display.skip(_steps_done(config, state))
            require_survivors(config, state.es)  # before anything is compiled
            num_stages = min(int(state.stage), config.num_stages)
            damages = run.damages(num_stages) if run else []
            for line in damages:
                display.say(f"{line}: the run goes on without a report")
        if int(state.stage) < config.total_stages:
            slots = slots_of(searcher, state)
            compile_ahead(searcher.population, state.training, slots, display)
        chunks = _chunks(run, searcher, state, display)
        state = keep_chunks(run, path, chunks, state, searcher.population.fetch)
        if run is not None:
            finish(run, searcher, state, display, num_episodes)
            page = write_report(path) if write_report and not damages else path
            display.say(f"done in {format_seconds(display.elapsed)}; open {page}")
        cluster.wait_for_all()


def _steps_done(config: SearchConfig, state: SearchState) -> int:
    stage = int(state.stage)
    epochs = sum(config.epochs_of(before) for before in range(stage))
    if stage < config.total_stages:
        epochs += int(state.epoch)
    return epochs * config.epoch_env_steps


def _chunks(
    run: RunDir | None, searcher: Searcher, state: SearchState, display: Display
) -> Iterator[Chunk]:
    """Train chunk after chunk; shows each, and writes down the stages that end."""
    config = searcher.config
    display.start_clock()
    for after, progress in evolve(config, state=state, searcher=searcher):
        rows = metric_rows(config.algorithms, progress.metrics)
        display.update(
            summarise(
                config, progress.stage, progress.epoch + len(rows), progress.metrics
            ),
            config.epoch_env_steps * len(rows),
        )
        for k, row in enumerate(rows):
            row |= {"stage": progress.stage, "epoch": progress.epoch + k}
            row["time/env_steps_per_second"] = display.steps_per_second
        if progress.result is not None:
            _write_stage(run, searcher, after, progress, progress.result)
            for line in stage_lines(config, progress.stage, progress.result):
                display.say(line)
        yield Chunk(
            state=after,
            first=progress.stage * config.train.num_epochs + progress.epoch,
            rows=rows,
            position={"stage": int(after.stage), "epoch": int(after.epoch)},
            is_end=int(after.stage) > progress.stage,
        )


def _write_stage(
    run: RunDir | None,
    searcher: Searcher,
    state: SearchState,
    progress: Progress,
    result: StageResult,
) -> None:
    """The stage's npz and the policies of its best candidate."""
    if run is not None:
        run.write_stage(progress.stage, _stage_arrays(searcher, state, result))
    if not np.asarray(result.fitness.finite).any():
        return  # no candidate is the best
    top = int(result.order[0]) * searcher.config.seeds_per_candidate  # its first seed
    for name, learner in zip(
        searcher.config.algorithms, progress.learners, strict=True
    ):
        policies = searcher.population.fetch(actor(learner.agent))
        params = jax.tree.map(lambda leaf: np.asarray(leaf)[top], policies)
        if run is not None:
            run.write_policy(policy_name(progress.stage, name), flatten(params))


def _stage_arrays(
    searcher: Searcher, state: SearchState, result: StageResult
) -> dict[str, np.ndarray]:
    """What stage_NN.npz holds."""
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
    return {name: np.asarray(value) for name, value in arrays.items()}
