"""The paper's table of computing times, beside what the benchmarks promise here.

    python benchmarks/env_steps.py                               # what it is made of
    python benchmarks/population.py --preset paper --parts update
    python experiments/computing_time.py

The evolution on a GPU is that of `benchmarks/gpu_session.sh`, as far as it has run.
Nothing is trained: hours are the paper's 10,000,000 steps and 333 updates, at its own
hyper-parameters and at the measured rates of a machine that is full. The paper had 64
hardware threads and two GPUs, and does not say whether its hours are of one agent or
of all that a task trains.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from autocost_jax import env_config, make_env, preset
from autocost_jax.bench import update_flop

BENCHMARKS = Path("benchmarks/results")
RESULT = Path("experiments/results/computing_time.json")
BATCH = 1024
PAPER_HOURS = {
    "Goal-Hazard-Point": 3.8,
    "Goal-Pillar-Point": 3.7,
    "Push-Hazard-Point": 4.4,
    "Push-Pillar-Point": 4.2,
    "Goal-Hazard-Car": 4.1,
    "Goal-Hazard-Doggo": 4.2,
}
PAPER_EVOLUTION = 54.1
CLOSED_FORM = "Goal-Hazard-Point, closed form"


def hours_of_an_agent(
    world: str, rate: float, updates: dict[str, dict[str, Any]]
) -> dict[str, float]:
    """Hours of rollout and of updates, per agent of each algorithm.

    Args:
      world: one of the paper's.
      rate: its env steps a second.
      updates: an algorithm's row of `population.py`; the time of another world's update
        is taken in proportion to its operations.
    """
    train = preset("paper").train
    own = dataclasses.replace(train, env=env_config(world))
    steps = train.num_worlds * train.env.num_steps * train.num_epochs
    result = {"rollout": steps / rate / 3600}
    env = make_env(own.env)
    for algorithm in preset("paper").algorithms:
        rate_of_updates = updates[algorithm]["tera_flop_per_second"] * 1e12
        seconds = update_flop(own, algorithm, env) / rate_of_updates
        result[algorithm] = result["rollout"] + train.num_epochs * seconds / 3600
    return result


def collect(benchmarks: Path) -> dict[str, Any]:
    """The table, from the newest results of the benchmarks."""
    steps = json.loads((benchmarks / "env_steps.json").read_text())["rows"]
    part = json.loads((benchmarks / "population_paper.json").read_text())["parts"]
    rates = {
        row["name"]: row["env_steps_per_second"]
        for row in steps
        if row["worlds"] == BATCH
    }
    devices = {(row["facts"]["device"], row["devices"]) for row in steps}
    devices |= {(part["update"]["facts"]["device"], part["update"]["devices"])}
    if len(devices) != 1:
        raise SystemExit(f"benchmarks of different devices: {sorted(devices)}")
    updates = {row["algorithm"]: row for row in part["update"]["rows"]}
    worlds = {
        world: hours_of_an_agent(world, rates[world], updates) for world in PAPER_HOURS
    }
    config = preset("paper")
    fast = hours_of_an_agent("Goal-Hazard-Point", rates[CLOSED_FORM], updates)
    agents = config.population_size * config.num_stages
    (device, count), *_ = devices
    return {
        "title": "Computing time",
        "command": "python experiments/computing_time.py",
        "device": f"{count} x {device}",
        "made_of": {
            "env_steps": sorted({row["command"] for row in steps}),
            "update": part["update"]["command"],
        },
        "paper_hours": PAPER_HOURS,
        "hours": worlds,
        "paper_evolution_hours": PAPER_EVOLUTION,
        "evolution_hours": agents * sum(fast[name] for name in updates),
        "gpu": on_a_gpu(benchmarks / "gpu" / "population_paper.json"),
    }


def on_a_gpu(file: Path) -> dict[str, Any] | None:
    """The whole evolution at the rate of its own program, if that was measured."""
    parts = json.loads(file.read_text())["parts"] if file.exists() else {}
    part = parts.get("closed_form")
    return part and {
        "device": part["facts"]["device"],
        "command": part["command"],
        "evolution_hours": part["search_hours"],
    }


def render(result: dict[str, Any]) -> str:
    """The table of the page of the experiments."""
    lines = [
        "| world | paper, hours | one PPO-Lag agent | one CPO agent | of it rollout |",
        "|---|---|---|---|---|",
    ]
    for world, hours in result["hours"].items():
        cells = [hours["ppo_lagrangian"], hours["cpo"], hours["rollout"]]
        lines.append(
            f"| {world} | {result['paper_hours'][world]} | "
            + " | ".join(f"{value:.2f}" for value in cells)
            + " |"
        )
    lines.append(
        f"| evolution, 700 agents | {result['paper_evolution_hours']} | "
        f"{result['evolution_hours']:.0f} for both | | |"
    )
    if result["gpu"]:
        lines.append(
            f"| the same on an {result['gpu']['device']} "
            f"| {result['paper_evolution_hours']} "
            f"| {result['gpu']['evolution_hours']:.1f} for both | | |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write JSON and table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--benchmarks", type=Path, default=BENCHMARKS)
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    result = collect(options.benchmarks)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    options.out.with_suffix(".md").write_text(render(result))
    print(options.out)


if __name__ == "__main__":
    main()
