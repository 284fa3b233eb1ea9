"""The main job: `python -m autocost_jax.evolve`.

Evolves intrinsic costs until agents stop violating the constraint. Everything about
the run lands in one directory: configuration, metrics, TensorBoard events,
checkpoints, the best cost and an HTML report. Where a flag is not given, the preset's
value holds.
"""

import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from autocost_jax.commandline import (
    config_with,
    guarded,
    parse,
    quiet,
    use_compile_cache,
    use_devices,
    with_flags,
)
from autocost_jax.config import SearchConfig, preset

PROG = "python -m autocost_jax.evolve"
PLANNED = {"laptop": 600.0}  # seconds that a preset promises on what it is for
SETTINGS = (  # fields of the configuration that have a flag of their own
    "physics",
    "seed",
    "algorithms",
    "cost_limit",
    "population_size",
    "num_elites",
    "num_stages",
    "num_epochs",
    "num_worlds",
    "num_finalists",
    "selection",
)


def main(argv: Sequence[str] | None = None, prog: str = PROG) -> None:
    """The command line; `argv` defaults to the program's, `prog` is its name."""
    argv = list(sys.argv[1:] if argv is None else argv)
    quiet()
    guarded(lambda: _main(argv, prog), prog)


def _main(argv: list[str], prog: str) -> None:
    options = parse(_options_type(), argv, prog, description=__doc__)
    flags = {name: getattr(options, name) for name in SETTINGS}
    base = _base(options)
    config = config_with(base, options.env, flags, options.set)
    use_compile_cache(options.compile_cache)
    # Before anything of JAX runs:
    group = (options.coordinator, options.num_processes, options.process_id)
    devices = use_devices(options.devices, *group)
    from autocost_jax.runs.search_run import plan, run_search
    from autocost_jax.viz.run_data import write_run_report

    sizes = options.preset or "laptop"
    name = f"{sizes}-{config.train.env.name}-seed{config.seed}"
    path = options.out or Path("runs") / name
    if options.dry_run:
        print(plan(config, path, len(devices)))
        return
    run_search(
        config,
        path,
        resume=options.resume,
        overwrite=options.overwrite,
        devices=devices,
        num_episodes=options.eval_episodes,
        planned=_planned(sizes, config),
        write_report=write_run_report,
    )


def _base(options: Any) -> SearchConfig:
    """What the flags come on top of: a preset, a file over it, or a run's settings."""
    from autocost_jax.runs.config_files import read_settings, replace_fields
    from autocost_jax.runs.directory import read_config

    base = preset(options.preset or "laptop")
    source = options.config
    if source is not None and source.is_file():
        return replace_fields(base, read_settings(source))
    if source is not None and options.preset is not None:
        raise ValueError(f"{source} has all settings: give no --preset beside it")
    if source is None and options.resume and options.preset is None:
        source = options.out
    return base if source is None else read_config(source)[0]


def _planned(name: str, config: SearchConfig) -> float | None:
    """Seconds that an unchanged preset promises."""
    is_as_planned = config.env_steps == preset(name).env_steps
    return PLANNED.get(name) if is_as_planned else None


@functools.cache
def _options_type() -> Any:
    """The flags; made here because tyro is imported only when it is used."""
    import tyro

    @dataclass(frozen=True)
    class Options:
        """Flags of the search.

        Attributes:
          preset: laptop (default): 2 CPU cores, 10 minutes; search: one GPU; paper: the
            paper's hyper-parameters; smoke: a test of the installation.
          config: YAML file of settings over the preset's, or run directory whose
            settings replace them.
          set: any setting by its name, as in `--set mutation_std=0.5`, once for each;
            `autocost info --preset laptop` lists them.
          env: one of the worlds that `autocost info` lists.
          out: run directory; default runs/PRESET-WORLD-seedN.
          resume: continue the run in `out` from its newest checkpoint.
          overwrite: start over in a directory that already holds a run.
          dry_run: say what would be done, and stop.
          eval_episodes: fresh episodes in which the best cost's agents are scored;
            default: 100, or on --resume as the run began.
          devices: devices to use; default: all; a CPU counts one a core.
          coordinator: of a run in several processes, HOST:PORT of the first one, or
            auto under SLURM and the like; start the command once for each of them.
          num_processes: of such a run; leave out with auto.
          process_id: of this one, from 0; leave out with auto.
          compile_cache: keep compiled programs in the user's cache directory.
        """

        preset: Literal["laptop", "search", "paper", "smoke"] | None = None
        config: Path | None = None
        set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
        env: str | None = None
        out: Path | None = None
        resume: bool = False
        overwrite: bool = False
        dry_run: bool = False
        eval_episodes: int | None = None
        devices: int | None = None
        coordinator: str | None = None
        num_processes: int | None = None
        process_id: int | None = None
        compile_cache: bool = True

    return with_flags(Options, SearchConfig, SETTINGS)


if __name__ == "__main__":
    main()
