"""`autocost`: train, evaluate, report, info."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from autocost_jax.commandline import (
    BAD_INPUT,
    flag,
    guarded,
    parse,
    quiet,
    use_devices,
    with_env,
)

HELP = """usage: autocost COMMAND [flags]

commands:
  train     train agents with any cost of the bank, several seeds at once
  evaluate  score the saved policies of a run over fresh episodes
  report    write a search's HTML report again
  info      versions, devices, environments, presets; or a run directory's facts

`autocost COMMAND --help` lists the flags; the search itself is
`python -m autocost_jax.evolve`.
"""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line; `argv` defaults to the program's."""
    argv = list(sys.argv[1:] if argv is None else argv)
    quiet()
    commands = {"train": _train, "evaluate": _evaluate, "report": _report}
    commands |= {"info": _info}
    if not argv or argv[0] in ("-h", "--help"):
        print(HELP, end="")
        raise SystemExit(0 if argv else BAD_INPUT)
    if argv[0] not in commands:
        known = ", ".join(commands)
        sys.stderr.write(f"autocost: unknown command {argv[0]!r}; commands: {known}\n")
        raise SystemExit(BAD_INPUT)
    guarded(lambda: commands[argv[0]](argv[1:]), f"autocost {argv[0]}")


def _train(argv: list[str]) -> None:
    import tyro

    from autocost_jax.config import TrainConfig, preset

    @dataclass(frozen=True)
    class Options:
        """Train agents with any training cost, several seeds at once.

        Attributes:
          env: one of the worlds that `autocost info` lists.
          algorithms: ppo, ppo_lagrangian, cpo: one method each.
          cost: terms of the cost bank, such as "extrinsic+0.1*safety_margin_2x".
          limit: allowed training cost of an episode.
          theta: cost.npz with the intrinsic network, if the cost uses it.
          num_seeds: seeds 0 ... N - 1.
          preset: whose sizes the other flags default to.
          out: run directory.
          resume: continue the run in `out` with its own settings.
          overwrite: start over in a directory that already holds a run.
          devices: devices to use; default: all; a CPU counts one a core.
          episodes: fresh episodes a policy is scored in.
          train: worlds, epochs and the learners' settings.
        """

        env: str = "Goal-Hazard-Point"
        algorithms: tuple[Literal["ppo", "ppo_lagrangian", "cpo"], ...] = (
            "ppo_lagrangian",
        )
        cost: str = "extrinsic"
        limit: float = 0.0
        theta: Path | None = None
        num_seeds: int = 1
        preset: Literal["laptop", "search", "paper", "smoke"] = "laptop"
        out: Path = Path("runs/train")
        resume: bool = False
        overwrite: bool = False
        devices: int | None = None
        episodes: int = 100
        train: Annotated[TrainConfig, tyro.conf.OmitArgPrefixes] = field(
            default_factory=TrainConfig
        )

    train = preset(flag(argv, "--preset") or "laptop").train
    default = Options(train=with_env(train, argv))
    options = parse(Options, argv, "autocost train", default=default)
    devices = use_devices(options.devices)  # before anything of JAX runs
    from autocost_jax.methods import Method, TableConfig, run_table
    from autocost_jax.store import read_config

    if options.resume:
        config, _ = read_config(options.out, TableConfig)
    else:
        theta = _theta(options.theta)
        config = TableConfig(
            train=options.train,
            methods=tuple(
                Method(name, name, options.cost, options.limit, theta)
                for name in options.algorithms
            ),
            seeds=tuple(range(options.num_seeds)),
        )
    run_table(
        config,
        options.out,
        resume=options.resume,
        overwrite=options.overwrite,
        devices=devices,
        num_episodes=options.episodes,
    )


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
        """

        run: Path
        policies: tuple[str, ...] = ()
        episodes: int = 100
        deterministic: bool = False
        seed: int = 0
        json: Path | None = None

    options = parse(Options, argv, "autocost evaluate")
    if options.episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {options.episodes}")
    import jax

    from autocost_jax.arrays import RunDirError, write_atomic
    from autocost_jax.envs.env import make_env
    from autocost_jax.policies import (
        EVALUATION,
        eval_summary,
        load_policies,
        score_line,
    )
    from autocost_jax.population import make_evaluator
    from autocost_jax.rundata import to_json

    config = _run_config(options.run)
    known = sorted(file.stem for file in (options.run / "policies").glob("*.npz"))
    names = options.policies or known
    odd = [name for name in names if name not in known]
    if odd or not names:
        raise RunDirError(
            f"{options.run} has no policy {odd[0] if odd else ''!r}; "
            f"policies: {', '.join(known) or 'none'}"
        )
    files = [options.run / "policies" / f"{name}.npz" for name in names]
    agent, states = load_policies(config.train, files)
    env = make_env(config.train.env)
    run = make_evaluator(env, agent, options.episodes, options.deterministic)
    key = jax.random.fold_in(jax.random.key(options.seed), EVALUATION)
    results, _ = run(states, key)
    rows = []
    for i, name in enumerate(names):
        row = eval_summary(jax.tree.map(lambda x, i=i: x[i], results))
        rows.append({"policy": name, **row})
        print(score_line(name, row))
    if options.json is not None:
        text = json.dumps(to_json(rows), indent=2, allow_nan=False)
        write_atomic(options.json, text.encode() + b"\n")


def _run_config(path: Path) -> Any:
    """The configuration of a run directory of either kind."""
    from autocost_jax.methods import TableConfig
    from autocost_jax.rundata import read_document
    from autocost_jax.store import SearchConfig, read_config

    config = read_document(path).get("config")
    is_table = isinstance(config, dict) and "methods" in config
    return read_config(path, TableConfig if is_table else SearchConfig)[0]


def _report(argv: list[str]) -> None:
    @dataclass(frozen=True)
    class Options:
        """Write a search's HTML report again.

        Attributes:
          run: run directory of a search, finished or not.
          out: where to write; default: report/index.html in the run directory.
        """

        run: Path
        out: Path | None = None

    options = parse(Options, argv, "autocost report")
    from autocost_jax.report import write_report
    from autocost_jax.summary import load_report

    out = options.out or options.run / "report" / "index.html"
    print(write_report(load_report(options.run), out))


def _info(argv: list[str]) -> None:
    @dataclass(frozen=True)
    class Options:
        """Versions, devices, environments and presets; or the facts of a run.

        Attributes:
          run: a run directory.
        """

        run: Path | None = None

    options = parse(Options, argv, "autocost info")
    import yaml

    if options.run is not None:
        from autocost_jax.rundata import read_document

        print(yaml.safe_dump(read_document(options.run), sort_keys=False), end="")
        return
    from autocost_jax.config import PRESETS
    from autocost_jax.costs import BANK
    from autocost_jax.env_config import ENVS, SUITE
    from autocost_jax.store import run_facts

    facts = run_facts()
    facts.pop("seed")
    facts |= {
        "environments": list(ENVS),
        "safety gym suite": list(SUITE),
        "presets": {name: f"{p.env_steps:,} env steps" for name, p in PRESETS.items()},
        "cost terms": [term.name for term in BANK],
    }
    print(yaml.safe_dump(facts, sort_keys=False), end="")


if __name__ == "__main__":
    main()
