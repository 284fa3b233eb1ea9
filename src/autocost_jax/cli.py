"""`autocost`: evolve, demo, train, evaluate, render, report, envs, bench, info."""

import importlib.metadata
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from autocost_jax.commandline import (
    BAD_INPUT,
    config_with,
    guarded,
    parse,
    quiet,
    use_compile_cache,
    use_devices,
    with_flags,
)
from autocost_jax.config import AlgorithmName, TrainConfig
from autocost_jax.evolve.__main__ import main as evolve
from autocost_jax.showing import demo, envs, render, report, run_config

HELP = """usage: autocost COMMAND [flags]

commands:
  evolve    search a cost: the same as `python -m autocost_jax.evolve`
  demo      two shipped policies side by side in one page; no training
  train     train agents with any cost of the bank, several seeds at once
  evaluate  score the saved policies of a run over fresh episodes
  render    replay an episode of a policy: an HTML page, and a film if asked for
  report    write a search's HTML report again
  envs      a picture and the facts of every world
  bench     how fast worlds step and agents learn on this machine
  info      versions, devices, environments, presets; or a run directory's facts

`autocost COMMAND --help` lists the flags; `autocost --version` says which version.
"""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; `argv` defaults to the program's."""
    argv = list(sys.argv[1:] if argv is None else argv)
    quiet()
    commands = {
        "demo": demo,
        "train": _train,
        "evaluate": _evaluate,
        "render": render,
    }
    commands |= {"report": report, "envs": envs, "bench": _bench, "info": _info}
    if not argv or argv[0] in ("-h", "--help"):
        print(HELP, end="")
        raise SystemExit(0 if argv else BAD_INPUT)
    if argv[0] == "--version":
        print(f"autocost {importlib.metadata.version('autocost-jax')}")
        return
    if argv[0] == "evolve":
        evolve(argv[1:], "autocost evolve")
        return
    if argv[0] not in commands:
        known = ", ".join(["evolve", *commands])
        sys.stderr.write(f"autocost: unknown command {argv[0]!r}; commands: {known}\n")
        raise SystemExit(BAD_INPUT)
    guarded(lambda: commands[argv[0]](argv[1:]), f"autocost {argv[0]}")


def _train(argv: list[str]) -> None:
    import tyro

    @dataclass(frozen=True)
    class Options:
        """Train agents with any training cost, several seeds at once.

        Attributes:
          preset: whose settings the training has; default: laptop.
          set: any of them by its name, as in `--set hidden_sizes=[64,64]`, once for
            each; `autocost info --preset laptop` lists them.
          env: one of the worlds that `autocost info` lists.
          algorithms: ppo, ppo_lagrangian, cpo, focops, pid_lagrangian: one method
            each; default: the second.
          cost: terms of the cost bank, such as "extrinsic+0.1*safety_margin_2x";
            default: extrinsic.
          limit: allowed training cost per episode; default: 0.
          theta: cost.npz with the intrinsic network, if the cost uses it; or the name
            of one that `autocost info` lists.
          num_seeds: seeds 0 ... N - 1; default: 1.
          out: run directory.
          resume: continue the run in `out` with its own methods and settings, to which
            the other flags default; only population_chunk may be another.
          overwrite: start over in a directory that already holds a run.
          devices: devices to use; default: all; a CPU counts one a core.
          coordinator: of a run in several processes, HOST:PORT of the first one, or
            auto under SLURM and the like; start the command once for each of them.
          num_processes: of such a run; leave out with auto.
          process_id: of this one, from 0; leave out with auto.
          compile_cache: keep compiled programs in the user's cache directory.
          episodes: fresh episodes a policy is scored in; default: 100, or on --resume
            as the run began.
        """

        preset: Literal["laptop", "search", "paper", "smoke"] | None = None
        set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
        env: str | None = None
        algorithms: tuple[AlgorithmName, ...] | None = None
        cost: str | None = None
        limit: float | None = None
        theta: Path | None = None
        num_seeds: int | None = None
        out: Path = Path("runs/train")
        resume: bool = False
        overwrite: bool = False
        devices: int | None = None
        coordinator: str | None = None
        num_processes: int | None = None
        process_id: int | None = None
        compile_cache: bool = True
        episodes: int | None = None

    names = ("physics", "num_epochs", "num_worlds")
    flagged = with_flags(Options, TrainConfig, names)
    options = parse(flagged, argv, "autocost train")
    recorded, train = _train_base(options)
    flags = {name: getattr(options, name) for name in names}
    train = config_with(train, options.env, flags, options.set)
    use_compile_cache(options.compile_cache)
    # Before anything of JAX runs:
    group = (options.coordinator, options.num_processes, options.process_id)
    devices = use_devices(options.devices, *group)
    from autocost_jax.runs.sweep import run_sweep

    run_sweep(
        _table(options, recorded, train),
        options.out,
        resume=options.resume,
        overwrite=options.overwrite,
        devices=devices,
        num_episodes=options.episodes,
    )


def _train_base(options: Any) -> tuple[Any, Any]:
    """The recorded table on --resume, else None; and what other flags come on top of.

    The latter is the `TrainConfig` of a preset, or on --resume without one the run's.
    """
    from autocost_jax.config import preset

    recorded = None
    if options.resume:
        from autocost_jax.runs.config_files import read_config
        from autocost_jax.runs.sweep import SweepConfig

        recorded, _ = read_config(options.out, SweepConfig)
    if recorded is None or options.preset is not None:
        return recorded, preset(options.preset or "laptop").train
    return recorded, recorded.train


def _table(options: Any, recorded: Any, train: Any) -> Any:
    """The `SweepConfig` of the flags; those not given default to the recorded table."""
    from autocost_jax.runs.sweep import Method, SweepConfig

    names = ("algorithms", "cost", "limit", "theta", "num_seeds")
    flags = {name: getattr(options, name) for name in names}
    given = {name: value for name, value in flags.items() if value is not None}
    if recorded is None:
        recorded = SweepConfig(methods=(Method("ppo_lagrangian"),))
    table = replace(recorded, train=train)
    if not given:
        return table
    first = recorded.methods[0]
    cost, limit = given.get("cost", first.cost), given.get("limit", first.limit)
    theta = _theta(given["theta"]) if "theta" in given else first.theta
    algorithms = given.get("algorithms", [row.algorithm for row in recorded.methods])
    seeds = range(given["num_seeds"]) if "num_seeds" in given else recorded.seeds
    methods = tuple(Method(name, name, cost, limit, theta) for name in algorithms)
    return replace(table, methods=methods, seeds=tuple(seeds))


def _theta(path: Path | None) -> tuple[float, ...] | None:
    from autocost_jax.costs import load_cost

    return None if path is None else tuple(load_cost(path).tolist())


def _evaluate(argv: list[str]) -> None:
    @dataclass(frozen=True)
    class Options:
        """Score the saved policies of a run over fresh episodes.

        Attributes:
          run: run directory of a search or of `autocost train`.
          policies: names of files in its policies/; default: all.
          episodes: fresh episodes a policy.
          deterministic: act by the mean instead of sampling.
          seed: of the episodes.
          json: file to write the scores to.
          compile_cache: keep compiled programs in the user's cache directory.
        """

        run: Path
        policies: tuple[str, ...] = ()
        episodes: int = 100
        deterministic: bool = False
        seed: int = 0
        json: Path | None = None
        compile_cache: bool = True

    options = parse(Options, argv, "autocost evaluate")
    if options.episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {options.episodes}")
    use_compile_cache(options.compile_cache)
    import jax

    from autocost_jax.envs.env import make_env
    from autocost_jax.files import write_atomic
    from autocost_jax.population import make_evaluator
    from autocost_jax.records import root_key
    from autocost_jax.runs.config_files import to_json
    from autocost_jax.runs.limits import require_evaluation
    from autocost_jax.runs.policies import (
        EVALUATION,
        eval_summaries,
        load_policies,
        policy_files,
        score_line,
    )

    config = run_config(options.run)
    files = policy_files(options.run, options.policies)
    env = make_env(config.train.env)
    require_evaluation(env, len(files), options.episodes, jax.devices())
    agent, states = load_policies(env, config.train, files)
    run = make_evaluator(env, agent, options.episodes, options.deterministic)
    key = jax.random.fold_in(root_key(options.seed), EVALUATION)
    results, _ = run(states, key)
    rows = []
    for file, row in zip(files, eval_summaries(results), strict=True):
        rows.append({"policy": file.stem, **row})
        print(score_line(file.stem, row))
    if options.json is not None:
        text = json.dumps(to_json(rows), indent=2, allow_nan=False)
        write_atomic(options.json, text.encode() + b"\n")


def _bench(argv: list[str]) -> None:
    @dataclass(frozen=True)
    class Options:
        """How fast worlds step and agents learn; compiles are cold.

        Attributes:
          preset: whose program is timed.
          envs: worlds whose steps are timed; default: the paper's, in MJX and in
            closed form.
          batch: of these worlds.
          devices: devices to use; default: all; a CPU counts one a core.
          json: file to write the rows to.
        """

        preset: Literal["laptop", "search", "paper", "smoke"] = "laptop"
        envs: tuple[str, ...] = ()
        batch: int = 1024
        devices: int | None = None
        json: Path | None = None

    options = parse(Options, argv, "autocost bench")
    devices = use_devices(options.devices)  # before anything of JAX runs
    from autocost_jax.bench import bench
    from autocost_jax.config import EnvConfig, env_config, preset
    from autocost_jax.files import write_atomic
    from autocost_jax.runs.directory import run_facts

    if options.batch < 1 or options.batch % len(devices):
        count = len(devices)
        raise ValueError(f"batch must be a multiple of {count}, got {options.batch}")
    envs = [env_config(name) for name in options.envs]
    envs = envs or [EnvConfig(), EnvConfig(physics="closed_form")]
    facts, rows = run_facts(), []
    facts.pop("seed")
    print(f"{len(devices)} device(s) of kind {devices[0].device_kind}", flush=True)
    print(f"{'':46}{'worlds':>8}{'compile s':>11}{'MB':>7}{'env steps/s':>13}")
    for row in bench(preset(options.preset), envs, options.batch, devices):
        rows.append(row._asdict())
        print(
            f"{row.env + ', ' + row.physics + ': ' + row.what:46}{row.worlds:>8}"
            f"{row.compile_seconds:>11.1f}{row.workspace_bytes / 1e6:>7.0f}"
            f"{row.env_steps_per_second:>13,}",
            flush=True,
        )
    if options.json is not None:
        command = " ".join(["autocost bench", *argv])
        result = {"command": command, "facts": facts, "rows": rows}
        write_atomic(options.json, json.dumps(result, indent=1).encode() + b"\n")


def _info(argv: list[str]) -> None:
    @dataclass(frozen=True)
    class Options:
        """Versions, devices, environments; or the facts of a run, or a preset.

        Attributes:
          run: a run directory.
          preset: all settings of a preset and what each is for, as YAML that
            `--config` reads.
        """

        run: Path | None = None
        preset: Literal["laptop", "search", "paper", "smoke"] | None = None

    options = parse(Options, argv, "autocost info")
    import yaml

    from autocost_jax.config import ENVS, PRESETS, SUITE, preset
    from autocost_jax.runs.config_files import read_document, settings_text

    if options.run is not None:
        print(yaml.safe_dump(read_document(options.run), sort_keys=False), end="")
        return
    if options.preset is not None:
        print(settings_text(preset(options.preset)), end="")
        return
    from autocost_jax.costs import BANK, list_costs
    from autocost_jax.runs.directory import run_facts

    facts = run_facts()
    facts.pop("seed")
    facts |= {
        "environments": list(ENVS),
        "safety gym suite": list(SUITE),
        "presets": {name: f"{p.env_steps:,} env steps" for name, p in PRESETS.items()},
        "cost terms": [term.name for term in BANK],
        "found costs": list_costs(),
    }
    print(yaml.safe_dump(facts, sort_keys=False), end="")


if __name__ == "__main__":
    main()
