"""The main job: `python -m autocost_jax.evolve`.

Evolves intrinsic costs until agents stop violating the constraint. Everything about
the run lands in one directory: configuration, metrics, TensorBoard events,
checkpoints, the best cost and an HTML report.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from autocost_jax.commandline import (
    fail,
    flag,
    guarded,
    parse,
    quiet,
    switch,
    use_compile_cache,
    use_devices,
    with_env,
)
from autocost_jax.config import PRESETS, SearchConfig, preset

PROG = "python -m autocost_jax.evolve"
PLANNED = {"laptop": 600.0}  # seconds that a preset promises on what it is for


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; `argv` defaults to the program's."""
    argv = list(sys.argv[1:] if argv is None else argv)
    quiet()
    guarded(lambda: _main(argv), PROG)


def _main(argv: list[str]) -> None:
    defaults = _defaults(argv)
    options = parse(_options_type(), argv, PROG, default=defaults, description=__doc__)
    use_compile_cache(options.compile_cache)
    # Before anything of JAX runs:
    group = (options.coordinator, options.num_processes, options.process_id)
    devices = use_devices(options.devices, *group)
    config = options.search
    from autocost_jax.runs.search_run import describe, run_search
    from autocost_jax.viz.run_data import write_run_report

    name = f"{options.preset}-{config.train.env.name}-seed{config.seed}"
    path = options.out or Path("runs") / name
    if options.dry_run:
        print("\n".join([*describe(config, len(devices)), f"would write to {path}"]))
        return
    run_search(
        config,
        path,
        resume=options.resume,
        overwrite=options.overwrite,
        devices=devices,
        num_episodes=options.eval_episodes,
        planned=_planned(options.preset, config),
        write_report=write_run_report,
    )


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
          preset: laptop: 2 CPU cores, 10 minutes; search: one GPU; paper: the
            paper's hyper-parameters; smoke: a test of the installation. The other
            flags default to the preset's values.
          config: run directory whose config.yaml replaces the preset's values.
          env: one of the worlds that `autocost info` lists.
          out: run directory; default runs/PRESET-WORLD-seedN.
          resume: continue the run in `out` from its newest checkpoint.
          overwrite: start over in a directory that already holds a run.
          devices: devices to use; default: all; a CPU counts one a core.
          coordinator: of a run in several processes, HOST:PORT of the first one, or
            auto under SLURM and the like; start the command once for each of them.
          num_processes: of such a run; leave out with auto.
          process_id: of this one, from 0; leave out with auto.
          compile_cache: keep compiled programs in the user's cache directory.
          dry_run: say what would be done, and stop.
          eval_episodes: fresh episodes in which the best cost's agents are scored.
          search: the search's settings.
        """

        preset: Literal["laptop", "search", "paper", "smoke"] = "laptop"
        config: Path | None = None
        env: str | None = None
        out: Path | None = None
        resume: bool = False
        overwrite: bool = False
        devices: int | None = None
        coordinator: str | None = None
        num_processes: int | None = None
        process_id: int | None = None
        compile_cache: bool = True
        dry_run: bool = False
        eval_episodes: int = 100
        search: Annotated[SearchConfig, tyro.conf.OmitArgPrefixes] = field(
            default_factory=SearchConfig
        )

    return Options


def _defaults(argv: list[str]) -> Any:
    """Options with the values of a preset or of a run; on --resume of that run."""
    name = flag(argv, "--preset") or "laptop"
    if name not in PRESETS:
        fail(f"{PROG}: unknown preset {name!r}; presets: {', '.join(PRESETS)}")
    config = preset(name)
    out, source = flag(argv, "--out"), flag(argv, "--config")
    if source is None and switch(argv, "--resume") and flag(argv, "--preset") is None:
        source = out
    if source is not None:
        from autocost_jax.runs.directory import read_config

        config, _ = read_config(Path(source))
    config = dataclasses.replace(config, train=with_env(config.train, argv))
    return _options_type()(preset=name, search=config)


if __name__ == "__main__":
    main()
