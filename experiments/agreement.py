"""Do the fast variants learn what the plain one learns?

    python experiments/agreement.py run       # train every variant, the same seeds
    python experiments/agreement.py collect   # JSON, table, figure of what has run

The plain variant is the closed-form Point with one segment per episode and float32
critics. The others change one thing: the physics engine, the cohorts, the critics'
precision. `--only NAME ...` takes some variants, `--smoke` shrinks everything to a
minute. Results are written to experiments/results/agreement/ (reduced scale).
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import REDUCED, Options, compact, run_if_needed, run_part, t_interval

from autocost_jax import TrainConfig, env_config, preset
from autocost_jax.runs.config_files import to_json
from autocost_jax.runs.directory import read_config, read_metrics, run_facts
from autocost_jax.runs.sweep import Method, SweepConfig

PLAIN = "plain"
# What differs from the plain variant: of the world, of the training, of the agent.
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    PLAIN: ({}, {}, {}),
    "MJX": ({"physics": "reduced"}, {}, {}),
    "5 cohorts": ({}, {"segments_per_episode": 5}, {}),
    "bfloat16 critics": ({}, {}, {"critic_precision": "bfloat16"}),
}
ALGORITHMS = ("ppo_lagrangian", "cpo")
EPOCHS, SEEDS, EPISODES = 100, tuple(range(10)), 50
SCORES = ("return_mean", "cost_mean")


def run(options: Options) -> None:
    """Train both algorithms with limit 0 in every variant."""
    methods = tuple(Method(name, name) for name in ALGORITHMS)
    for name in options.only or VARIANTS:
        train = variant(name, options.smoke)
        seeds = SEEDS[:2] if options.smoke else SEEDS
        config = SweepConfig(train, methods, seeds)
        episodes = 2 if options.smoke else EPISODES
        run_if_needed(config, folder(options, name), episodes)


def folder(options: Options, name: str) -> Path:
    """The run directory of a variant."""
    return options.runs / name.replace(" ", "_")


def variant(name: str, smoke: bool) -> TrainConfig:
    """The reduced learner, 8000 steps an epoch, with what the variant changes."""
    env_changes, train_changes, agent_changes = VARIANTS[name]
    train = TrainConfig(agent=REDUCED, num_worlds=8)
    env = dataclasses.replace(env_config("Goal-Hazard-Point"), physics="closed_form")
    if smoke:
        train = preset("smoke").train
        env = dataclasses.replace(env, num_steps=50)
    return dataclasses.replace(
        train,
        env=dataclasses.replace(env, **env_changes),
        agent=dataclasses.replace(train.agent, **agent_changes),
        num_epochs=4 if smoke else EPOCHS,
        **train_changes,
    )


def collect(options: Options) -> None:
    """Write the JSON, the table and the figure of whatever has been run."""
    options.results.mkdir(parents=True, exist_ok=True)
    done = [
        name
        for name in VARIANTS
        if (folder(options, name) / "evaluation.json").exists()
    ]
    result = {
        "command": "python experiments/agreement.py run",
        "facts": run_facts(),
        "update": "nets 64-64, 6 passes x 8 minibatches (reduced scale)",
        "variants": {name: collect_variant(folder(options, name)) for name in done},
    }
    result["differences"] = {
        name: {
            algorithm: {
                score: difference(
                    result["variants"][name]["scores"][algorithm][score],
                    result["variants"][PLAIN]["scores"][algorithm][score],
                )
                for score in SCORES
            }
            for algorithm in ALGORITHMS
        }
        for name in done
        if name != PLAIN
    }
    file = options.results / "agreement.json"
    file.write_text(compact(to_json(result)) + "\n")
    result = json.loads(file.read_text())
    file.with_suffix(".md").write_text(render(result))
    draw(result, options.results / "agreement.png")
    print(file)


def collect_variant(path: Path) -> dict[str, Any]:
    """Scores of fresh episodes, one a seed, and the curves of each algorithm."""
    config = read_config(path, SweepConfig)[0]
    evaluated = json.loads((path / "evaluation.json").read_text())
    rows = read_metrics(path)
    scores = {
        algorithm: {
            score: [
                row[score] for row in evaluated["rows"] if row["method"] == algorithm
            ]
            for score in SCORES
        }
        for algorithm in ALGORITHMS
    }
    curves: dict[str, Any] = {}
    for group in config.algorithms:
        names = [method.label for method, _ in config.group(group)]
        for algorithm in set(names):
            own = [i for i, name in enumerate(names) if name == algorithm]
            curves[algorithm] = {
                key: [
                    round(float(np.mean(np.take(row[f"{group}/{key}"], own))), 3)
                    for row in rows
                ]
                for key in ("ep_return", "ep_cost")
            }
    train = config.train
    return {
        "env": train.env.name,
        "steps_a_slot": train.num_worlds * train.env.num_steps * len(rows),
        "seeds": list(config.seeds),
        "episodes": evaluated["episodes"],
        "scores": scores,
        "curves": curves,
    }


def difference(values: list[float], plain: list[float]) -> dict[str, Any]:
    """Mean difference with a 95 % t-interval over seeds.

    A seed's two runs share their networks' start and their layouts, so the difference
    is taken seed by seed.
    """
    return t_interval(np.subtract(values, plain))


def render(result: dict[str, Any]) -> str:
    """One line for each variant: scores, and what differs from the plain variant."""
    lines = [
        "| variant | PPO-Lagrangian return, cost | differs by (95 %) "
        "| CPO return, cost | differs by (95 %) |",
        "|---|---|---|---|---|",
    ]
    for name, row in result["variants"].items():
        cells = [name]
        for algorithm in ALGORITHMS:
            means = [np.mean(row["scores"][algorithm][score]) for score in SCORES]
            cells.append(", ".join(f"{mean:.2f}" for mean in means))
            gaps = result["differences"].get(name, {}).get(algorithm, {})
            cells.append(
                ", ".join(
                    f"{gap['mean']:.2f} ({gap['low']:.2f} to {gap['high']:.2f})"
                    for gap in gaps.values()
                )
            )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(result: dict[str, Any], file: Path) -> None:
    """Mean curves over the seeds, a line a variant."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(ALGORITHMS), figsize=(9, 6), sharex=True)
    for column, algorithm in enumerate(ALGORITHMS):
        for row, key in enumerate(("ep_return", "ep_cost")):
            panel = axes[row, column]
            for name, run in result["variants"].items():
                panel.plot(run["curves"][algorithm][key], label=name, linewidth=1)
            panel.set_ylabel(key)
        axes[0, column].set_title(algorithm.replace("_", "-"))
        axes[1, column].set_xlabel("epoch of 8000 steps (reduced scale)")
    axes[0, 0].legend(fontsize=8)
    figure.suptitle(" and ".join({run["env"] for run in result["variants"].values()}))
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


PARTS: dict[str, Callable[[Options], None]] = {"run": run, "collect": collect}


if __name__ == "__main__":
    run_part("agreement", __doc__, PARTS, VARIANTS)
