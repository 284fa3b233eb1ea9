"""What the figures of the paper share: cost designs, training, statistics, pictures.

A *design* is a training cost and its limit, trained by PPO-Lagrangian and CPO with
every seed. A figure is a list of designs and worlds, see `figures.py`. What it lacks in
a world is trained side by side, as one table of slots; what another figure has trained
already is taken from there.

    python experiments/figures.py run cost_limits      # train what is not trained yet
    python experiments/figures.py collect cost_limits  # JSON, table, picture

`--scale reduced` (default) fits a CPU and is no result of the paper's scale, which is
`--scale paper`; `reduced_2m` trains four times as long. `reduced_10m` has the paper's
worlds and epochs with smaller networks and updates, and wants a GPU. `--smoke` shrinks
everything to a minute. Runs can be stopped and started again.

`--world Goal-Hazard8-Point` does the same in the crowded world of eight hazards, in
folders of its own, with the costs that were found there.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import REDUCED, compact, part_parser, run_if_needed, use_machine

from autocost_jax import TrainConfig, env_config, load_cost, preset
from autocost_jax.config import Algorithm
from autocost_jax.runs.config_files import to_json
from autocost_jax.runs.directory import read_config, read_metrics, run_facts
from autocost_jax.runs.sweep import AlgorithmName, Method, SweepConfig

RESULTS = Path("experiments/results")
WORLD, CROWDED = "Goal-Hazard-Point", "Goal-Hazard8-Point"
FOLDERS = {WORLD: WORLD, CROWDED: "eight_hazards"}  # of the worlds' runs and results
BOTH: tuple[Algorithm, ...] = ("ppo_lagrangian", "cpo")
NAMES = {"ppo": "PPO", "ppo_lagrangian": "PPO-Lag", "cpo": "CPO"}
CURVES = ("ep_return", "ep_cost", "ep_total_cost")


class Design(NamedTuple):
    """A training cost.

    Attributes:
      title: in legends and tables.
      cost: terms of the cost bank.
      limit: allowed cost per episode.
      found: key of the intrinsic network in `Scale.found`, if `cost` uses one.
      algorithms: that are trained with it.
    """

    title: str
    cost: str = "extrinsic"
    limit: float = 0.0
    found: str = ""
    algorithms: tuple[AlgorithmName, ...] = BOTH


WITH_NETWORK = "extrinsic+intrinsic"
SEEDS = (0, 1, 2, 3, 4)
DESIGNS: dict[str, Design] = {
    "unconstrained": Design("", algorithms=("ppo",)),
    "extrinsic": Design("limit 0"),
    "limit_0.5": Design("limit 0.5", limit=0.5),
    "limit_-0.1": Design("limit -0.1", limit=-0.1),
    "limit_-1": Design("limit -1", limit=-1.0),
    "distance_decrease": Design("distance decrease", "distance_decrease"),
    "distance_change": Design("distance change", "distance_change"),
    "distance_change_indicator": Design("its indicator", "distance_change_indicator"),
    "margin_1x": Design("margin 1x", "safety_margin_1x"),
    "margin_2x": Design("margin 2x", "safety_margin_2x"),
    "margin_3x": Design("margin 3x", "safety_margin_3x"),
    "steep": Design("steep network", WITH_NETWORK, found="steep"),
    "evolved": Design("evolved", WITH_NETWORK, found="evolved"),
    "evolved_alone": Design("evolved, w/o extrinsic", "intrinsic", found="evolved"),
    "evolved_dense": Design("evolved, dense", WITH_NETWORK, found="dense"),
    "evolved_reduced": Design("evolved at 512,000", WITH_NETWORK, found="brief"),
}

# Costs that were made or searched for: by world and scale, files or names of the
# package's. In the world of four hazards there is none yet.
COSTS = RESULTS / FOLDERS[CROWDED] / "costs"
BRIEF: dict[str, Path | str] = {
    "steep": COSTS / "steep",
    "evolved": COSTS / "lidar_mlp_8_brief",
}
LONG: dict[str, Path | str] = {
    "steep": COSTS / "steep",
    "evolved": "min_distance_8",
    "dense": "lidar_mlp_8",
    "brief": COSTS / "lidar_mlp_8_brief",
}
FOUND: dict[str, dict[str, dict[str, Path | str]]] = {
    WORLD: {},
    CROWDED: {
        "reduced": BRIEF,
        "reduced_2m": BRIEF,
        "reduced_10m": LONG,
        "paper": LONG,
        "smoke": BRIEF,
    },
}


class Scale(NamedTuple):
    """How much of everything, and where.

    Attributes:
      name: of `--scale`.
      train: sizes and the learners' settings, in any world.
      seeds: one slot each.
      episodes: fresh ones a policy is scored in.
      sizes: worlds a slot, epochs and episodes of slow worlds.
      world: of `FOLDERS`.
      found: costs that were searched for in it, by `Design.found`.
    """

    name: str
    train: TrainConfig
    seeds: tuple[int, ...] = SEEDS
    episodes: int = 200
    sizes: Mapping[str, tuple[int, int, int]] = {}
    world: str = WORLD
    found: Mapping[str, Path | str] = {}


def scales(world: str = WORLD) -> dict[str, Scale]:
    """`reduced`: smaller networks and minibatches, see `REDUCED`.

    512,000 steps a slot, fewer in slow worlds; `reduced_2m` is four times as long.
    `reduced_10m` has the paper's 333 epochs of 30 worlds, 9,990,000 steps a slot.
    """
    smoke = preset("smoke").train
    slow = {
        "Goal-Pillar-Point": (4, 64, 200),
        "Push-Hazard-Point": (4, 32, 50),
        "Push-Pillar-Point": (4, 32, 25),
        in_world("Goal-Hazard-Car", world): (4, 64, 50),
        in_world("Goal-Hazard-Doggo", world): (4, 64, 50),
    }
    slow_2m = {name: (n, 4 * t, episodes) for name, (n, t, episodes) in slow.items()}
    reduced = TrainConfig(agent=REDUCED, num_worlds=8, num_epochs=64, chunk_epochs=4)
    longer = dataclasses.replace(reduced, num_epochs=256)
    longest = TrainConfig(agent=REDUCED, num_worlds=30, num_epochs=333, chunk_epochs=37)
    known = (
        Scale("reduced", reduced, sizes=slow),
        Scale("reduced_2m", longer, sizes=slow_2m),
        Scale("reduced_10m", longest),
        Scale("paper", preset("paper").train),
        Scale("smoke", smoke, seeds=(0, 1), episodes=2),
    )
    found = FOUND[world]
    return {
        scale.name: scale._replace(world=world, found=found.get(scale.name, {}))
        for scale in known
    }


def in_world(name: str, world: str) -> str:
    """A Goal-Hazard world with as many hazards as `world` has; any other as it is."""
    return name.replace("Goal-Hazard-", world.removesuffix("Point"))


class Figure(NamedTuple):
    """A figure of the paper.

    Attributes:
      name: of its files.
      title: what it shows.
      paper: what the paper reports.
      designs: keys of `DESIGNS`.
      worlds: a column each; see `in_world`.
      curves: a row each, keys of `CURVES`.
    """

    name: str
    title: str
    paper: str
    designs: tuple[str, ...]
    worlds: tuple[str, ...] = (WORLD,)
    curves: tuple[str, ...] = ("ep_return", "ep_cost")


def table(world: str, designs: Sequence[str], scale: Scale) -> SweepConfig:
    """What is trained for some designs in one world."""
    env = env_config(world)
    if world in FOLDERS:  # equal to MJX to rounding, and faster
        env = dataclasses.replace(env, physics="closed_form")
    train, steps = scale.train, scale.train.env.num_steps
    worlds, epochs, _ = world_size(world, scale)
    train = dataclasses.replace(
        train,
        env=dataclasses.replace(env, num_steps=steps),
        num_worlds=worlds,
        num_epochs=epochs,
    )
    rows = tuple(row for design in designs for row in methods(design, scale))
    return SweepConfig(train, rows, scale.seeds)


def methods(design: str, scale: Scale) -> tuple[Method, ...]:
    """A design's rows of a table."""
    cost, theta = DESIGNS[design], None
    if cost.found:
        theta = tuple(load_cost(scale.found[cost.found]).tolist())
    return tuple(
        Method(f"{design}-{name}", name, cost.cost, cost.limit, theta)
        for name in cost.algorithms
    )


def world_size(world: str, scale: Scale) -> tuple[int, int, int]:
    """Worlds a slot, epochs and episodes."""
    usual = (scale.train.num_worlds, scale.train.num_epochs, scale.episodes)
    return scale.sizes.get(world, usual)


def steps_a_slot(train: TrainConfig) -> int:
    """Env steps that one slot is trained for."""
    return train.num_worlds * train.env.num_steps * train.num_epochs


def run(figure: Figure, scale: Scale, runs: Path) -> None:
    """Train what the figure lacks, side by side in each world and size of network."""
    without = [d for d in figure.designs if not exists(d, scale)]
    if without:
        print(f"no cost for {', '.join(without)} at {scale.name} in {scale.world} yet")
    wanted = distinct(figure.designs, scale)
    for world in figure.worlds:
        missing = [d for d in wanted if find(runs, world, d, scale) is None]
        for designs in by_network(missing, scale):
            config = table(world, designs, scale)
            episodes = world_size(world, scale)[2]
            run_if_needed(config, runs / world / "+".join(designs), episodes)


def by_network(designs: Sequence[str], scale: Scale) -> list[list[str]]:
    """Designs whose networks fit in one table; those without one go with the first."""
    groups: dict[int, list[str]] = {}
    without = []
    for design in designs:
        theta = methods(design, scale)[0].theta
        own = without if theta is None else groups.setdefault(len(theta), [])
        own.append(design)
    first, *others = groups.values() or [[]]
    return [group for group in ([*without, *first], *others) if group]


def distinct(designs: Sequence[str], scale: Scale) -> list[str]:
    """The designs that exist, without those that are another one at this scale."""
    designs = [design for design in designs if exists(design, scale)]
    contents = [[content(m) for m in methods(d, scale)] for d in designs]
    return [d for i, d in enumerate(designs) if contents[i] not in contents[:i]]


def exists(design: str, scale: Scale) -> bool:
    """Whether the cost of a design has been found at this scale in its world."""
    key = DESIGNS[design].found
    return not key or key in scale.found


def content(method: Method) -> Method:
    """A method whatever it is called."""
    return dataclasses.replace(method, label="-")


class Trained(NamedTuple):
    """Where a design has been trained.

    Attributes:
      path: the run directory.
      labels: what the design's algorithms are called there.
    """

    path: Path
    labels: dict[str, str]


def find(runs: Path, world: str, design: str, scale: Scale) -> Trained | None:
    """The finished run that holds a design, whatever else was trained in it."""
    wanted = table(world, [design], scale)
    for file in sorted((runs / world).glob("*/evaluation.json")):
        config = read_config(file.parent, SweepConfig)[0]
        labels = {content(method): method.label for method in config.methods}
        same = (config.train, config.seeds) == (wanted.train, wanted.seeds)
        if same and all(content(method) in labels for method in wanted.methods):
            own = {m.algorithm: labels[content(m)] for m in wanted.methods}
            return Trained(file.parent, own)
    return None


def scores(trained: Trained) -> dict[str, Any]:
    """Of a trained design: for each algorithm its scores, and its curves."""
    config, facts = read_config(trained.path, SweepConfig)
    rows = json.loads((trained.path / "evaluation.json").read_text())["rows"]
    metrics = read_metrics(trained.path)
    result: dict[str, Any] = {}
    for algorithm, label in trained.labels.items():
        group = "cpo" if algorithm == "cpo" else "ppo_lagrangian"
        slots = config.group(group)
        own = [i for i, (slot, _) in enumerate(slots) if slot.label == label]
        result[algorithm] = summarise([r for r in rows if r["method"] == label])
        result[algorithm]["curves"] = {
            name: curve([np.take(row[f"{group}/{name}"], own) for row in metrics])
            for name in CURVES
        }
    steps = steps_a_slot(config.train)
    names = ("commit", "created", "device", "num_devices")
    run = {name: facts[name] for name in names} | {"jax": facts["versions"]["jax"]}
    return {"steps_a_slot": steps, "trained": run, "algorithms": result}


def curve(values: Sequence[np.ndarray]) -> dict[str, list[float]]:
    """Mean, lowest and highest seed of each epoch; values [T][seeds]."""
    array = np.asarray(values)
    return {
        "mean": array.mean(1).round(3).tolist(),
        "low": array.min(1).round(3).tolist(),
        "high": array.max(1).round(3).tolist(),
    }


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores over seeds with bootstrap intervals, and the pooled rate of violations."""
    episodes = sum(row["episodes"] for row in rows)
    layouts = min(row["episodes"] for row in rows)  # all policies meet the same ones
    violations = sum(round(row["violation_rate"] * row["episodes"]) for row in rows)
    return {
        "return": bootstrap([row["return_mean"] for row in rows]),
        "cost": bootstrap([row["cost_mean"] for row in rows]),
        "distance_travelled": float(
            np.mean([row["distance_travelled"] for row in rows])
        ),
        "frozen": sum(row["frozen_epoch"] >= 0 for row in rows),
        "episodes": episodes,
        "violations": violations,
        "violation_rate": violations / episodes,
        "violation_rate_upper": upper_bound(violations / episodes, layouts),
    }


def bootstrap(values: Sequence[float], draws: int = 10_000) -> dict[str, Any]:
    """Mean of one value a seed, with the 95 % interval of the resampled mean."""
    array = np.asarray(values, np.float64)
    rng = np.random.default_rng(0)
    means = rng.choice(array, (draws, array.size)).mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return {
        "seeds": array.round(4).tolist(),
        "mean": float(array.mean()),
        "low": float(low),
        "high": float(high),
    }


def upper_bound(rate: float, layouts: int) -> float:
    """One-sided 95 % Clopper-Pearson bound of a rate; zero in N gives about 3 / N.

    N is the number of layouts, not of episodes: the policies of all seeds play the same
    ones. The bound speaks of these policies, not of training anew.
    """
    from scipy.stats import beta

    if rate >= 1:
        return 1.0
    return float(beta.ppf(0.95, rate * layouts + 1, (1 - rate) * layouts))


def collect(figure: Figure, scale: Scale, runs: Path, results: Path) -> None:
    """Write the JSON, the table and the picture of whatever has been run."""
    panels = {
        world: {
            design: scores(trained)
            for design in distinct(figure.designs, scale)
            if (trained := find(runs, world, design, scale)) is not None
        }
        for world in figure.worlds
    }
    facts = run_facts()
    facts.pop("seed")
    result = {
        "title": figure.title,
        "paper": figure.paper,
        "world": scale.world,
        "scale": scale.name,
        "command": command("figures", scale, figure.name),
        "found": {name: str(cost) for name, cost in scale.found.items()},
        "seeds": list(scale.seeds),
        "facts": facts,
        "worlds": {world: panel for world, panel in panels.items() if panel},
    }
    result = json.loads(json.dumps(to_json(result), allow_nan=False))
    file = write(result, figure.name, results)
    file.with_suffix(".md").write_text(render(result))
    draw(figure, result, file.with_suffix(".png"))
    print(file)


def command(script: str, scale: Scale, figure: str = "") -> str:
    """What trains what a script is about."""
    world = f"--world {scale.world} " if scale.world != WORLD else ""
    size = "--smoke" if scale.name == "smoke" else f"--scale {scale.name}"
    name = f"{figure} " if figure else ""
    return f"python experiments/{script}.py run {name}{world}{size}"


def write(result: dict[str, Any], name: str, results: Path) -> Path:
    """`results`/NAME.json."""
    results.mkdir(parents=True, exist_ok=True)
    file = results / f"{name}.json"
    file.write_text(compact(to_json(result)) + "\n")
    return file


def label(design: str, algorithm: str) -> str:
    """As in the paper's legends: CPO, limit 0."""
    title = DESIGNS[design].title
    return NAMES[algorithm] + (f", {title}" if title else "")


def caption(result: dict[str, Any], world: str) -> str:
    """How much the numbers of a world rest on."""
    panel = result["worlds"][world]
    steps = {design["steps_a_slot"] for design in panel.values()}
    episodes = {a["episodes"] for d in panel.values() for a in d["algorithms"].values()}
    seeds = len(result["seeds"])
    return (
        f"{result['scale']} scale: {max(steps):,} steps a slot, {seeds} seeds, "
        f"{max(episodes)} fresh episodes a method"
    )


def render(result: dict[str, Any]) -> str:
    """A table for each world."""
    parts = []
    for world, panel in result["worlds"].items():
        lines = [
            f"{world} ({caption(result, world)})",
            "",
            "| method | return (95 %) | extrinsic cost (95 %) "
            "| violating episodes | at most (95 %) |",
            "|---|---|---|---|---|",
        ]
        for design, trained in panel.items():
            for algorithm, row in trained["algorithms"].items():
                cells = [label(design, algorithm)]
                cells += [
                    f"{row[key]['mean']:.{digits}f} "
                    f"({row[key]['low']:.{digits}f} to {row[key]['high']:.{digits}f})"
                    for key, digits in (("return", 1), ("cost", 2))
                ]
                cells.append(f"{row['violations']} of {row['episodes']}")
                cells.append(f"{row['violation_rate_upper']:.1%}")
                lines.append("| " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


AXES = {
    "ep_return": "return per episode",
    "ep_cost": "extrinsic cost per episode",
    "ep_total_cost": "training cost per episode",
}


def draw(figure: Figure, result: dict[str, Any], file: Path) -> None:
    """Learning curves, means of 5 epochs; a column a world, bands over the seeds."""
    from matplotlib.figure import Figure as Picture

    worlds, rows = list(result["worlds"]), figure.curves
    if not worlds:
        return
    size = (1.5 + 3.6 * len(worlds), 1.2 + 2.4 * len(rows))
    picture = Picture(figsize=size, layout="constrained")
    axes = picture.subplots(len(rows), len(worlds), squeeze=False)
    for column, world in enumerate(worlds):
        for design, trained in result["worlds"][world].items():
            color = f"C{figure.designs.index(design)}"
            for algorithm, row in trained["algorithms"].items():
                style = {"cpo": "--", "ppo": ":"}.get(algorithm, "-")
                for index, name in enumerate(rows):
                    values = row["curves"][name]
                    share = np.arange(1, 1 + len(values["mean"])) / len(values["mean"])
                    steps = share * trained["steps_a_slot"]
                    panel = axes[index, column]
                    panel.plot(
                        steps,
                        smooth(values["mean"]),
                        style,
                        color=color,
                        label=label(design, algorithm),
                    )
                    low, high = smooth(values["low"]), smooth(values["high"])
                    panel.fill_between(steps, low, high, color=color, alpha=0.1)
        title = caption(result, world).replace("slot, ", "slot,\n")
        axes[0, column].set_title(f"{world}\n{title}", fontsize=7)
        axes[-1, column].set_xlabel("env steps a slot")
        for panel in axes[:, column]:
            panel.locator_params(axis="x", nbins=5)
    for index, name in enumerate(rows):
        axes[index, 0].set_ylabel(AXES[name])
        if name != "ep_return":
            for panel in axes[index]:
                panel.set_yscale("symlog", linthresh=0.1)
                panel.axhline(0, color="r", linewidth=0.8)
    lines, names = axes[0, 0].get_legend_handles_labels()
    picture.legend(lines, names, fontsize=6, ncols=3, loc="outside lower center")
    picture.suptitle(figure.title, fontsize=9)
    picture.savefig(file, dpi=130)


def smooth(values: Sequence[float], width: int = 5) -> np.ndarray:
    """Means over the last epochs, as far as there are any."""
    array = np.asarray(values, np.float64)
    sums = np.cumsum(np.insert(array, 0, 0.0))
    end = np.arange(1, len(array) + 1)
    start = np.maximum(end - width, 0)
    return (sums[end] - sums[start]) / (end - start)


def parser(
    description: str | None,
    parts: Iterable[str] = ("run", "collect"),
    scales: Sequence[str] = ("reduced", "reduced_2m", "reduced_10m", "paper"),
) -> argparse.ArgumentParser:
    """The flags of an experiment's script."""
    parser = part_parser(description, parts)
    parser.add_argument("--scale", choices=scales, default="reduced")
    parser.add_argument("--world", choices=FOLDERS, default=WORLD)
    return parser


def arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The parsed flags; devices and the compile cache are set up."""
    args = parser.parse_args()
    args.scale = "smoke" if args.smoke else args.scale
    folder = Path(FOLDERS[args.world]) / args.scale
    args.runs = args.runs or "runs/figures" / folder
    where = args.runs / "results" if args.smoke else RESULTS / folder
    args.results = args.results or where
    use_machine()
    return args


def main(figures: Sequence[Figure], description: str | None) -> None:
    """The command line of the figures."""
    known = {figure.name: figure for figure in figures}
    flags = parser(description)
    flags.add_argument("figure", choices=known)
    flags.add_argument("--only", nargs="+", help="worlds to run")
    args = arguments(flags)
    figure, scale = known[args.figure], scales(args.world)[args.scale]
    only = args.only if args.part == "run" and args.only else figure.worlds
    if not set(only) <= set(figure.worlds):
        flags.error(f"--only must be out of {', '.join(figure.worlds)}")
    worlds = tuple(in_world(name, args.world) for name in only)
    figure = figure._replace(worlds=worlds)
    if args.part == "run":
        run(figure, scale, args.runs)
    else:
        collect(figure, scale, args.runs, args.results)
