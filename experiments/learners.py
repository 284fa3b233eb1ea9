"""What learner settings are worth at equal env steps, from REDUCED to the presets'.

    python experiments/learners.py run                 # all settings
    python experiments/learners.py run --only NAME     # some of them
    python experiments/learners.py collect             # JSON and table

Every setting but the last trains PPO-Lagrangian and CPO on Goal-Hazard-Point in closed
form for 512,000 env steps a slot with five seeds and three costs: the extrinsic one
alone, and with a margin of 2x and 3x. Scores are of 200 fresh episodes a seed, actions
sampled.
What has been measured before and is not in the runs stays in the JSON.
"""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

from common import REDUCED, Options, compact, run_if_needed, run_part, t_interval

from autocost_jax.config import EnvConfig, TrainConfig
from autocost_jax.runs.directory import read_config
from autocost_jax.runs.sweep import AlgorithmName, Method, SweepConfig

STEPS, SEEDS, EPISODES = 512_000, (0, 1, 2, 3, 4), 200
COSTS = ("extrinsic", "extrinsic+safety_margin_2x", "extrinsic+safety_margin_3x")
NORM = {"normalize_obs": True}
SMALL: dict[str, Any] = {
    "normalize_obs": True,
    "hidden_sizes": (32, 32),
    "target_kl": 0.02,
    "policy_passes": 4,
    "value_passes": 4,
    "cg_iterations": 5,
}
MILD = SMALL | {"multiplier_init": 0.5, "multiplier_lr": 0.01}
SHORT = MILD | {"gae_lambda": 0.95, "cost_gae_lambda": 0.95}
STILL = SHORT | {"policy_output_scale": 0.01}
WIDE = STILL | {"multiplier_init": 1.0, "target_kl": 0.03, "violation_factor": 1.6}
WIDE |= {"value_passes": 3}
# name -> worlds an epoch, segments per episode, agent settings that differ from REDUCED
SETTINGS: dict[str, tuple[int, int, dict[str, Any]]] = {
    "as before": (8, 1, {}),
    "normalised": (8, 1, NORM),
    "4 worlds": (4, 1, NORM),
    "4 worlds, multiplier lr 0.02": (4, 1, NORM | {"multiplier_lr": 0.02}),
    "4 worlds in 4 cohorts": (4, 4, NORM),
    "32-32, multiplier from 1 at 0.02": (8, 1, SMALL | {"multiplier_lr": 0.02}),
    "32-32, multiplier from 0.5 at 0.01": (8, 1, MILD),
    "and lambda 0.95": (8, 1, SHORT),
    "and a policy that begins all but still": (8, 1, STILL),
    # The learner of `laptop` and `search`.
    "and a multiplier from 1, a KL bound of 0.03, CPO's violation x 1.6": (8, 1, WIDE),
}
OTHERS = "the presets' learner, but a PID multiplier, and FOCOPS for CPO"
SETTINGS[OTHERS] = (8, 1, WIDE)
ALGORITHMS: tuple[AlgorithmName, ...] = ("ppo_lagrangian", "cpo")
OTHER_ALGORITHMS: tuple[AlgorithmName, ...] = ("pid_lagrangian", "focops")


def algorithms_of(name: str) -> tuple[AlgorithmName, ...]:
    """What a setting trains, in the order of the table's columns."""
    return OTHER_ALGORITHMS if name == OTHERS else ALGORITHMS


def config_of(name: str, steps: int = STEPS, episode: int = 1000) -> SweepConfig:
    """The table that one setting trains."""
    worlds, segments, changes = SETTINGS[name]
    train = TrainConfig(
        env=EnvConfig(physics="closed_form", num_steps=episode),
        agent=dataclasses.replace(REDUCED, **changes),
        num_worlds=worlds,
        segments_per_episode=segments,
        num_epochs=max(1, steps // (worlds * episode)),
    )
    methods = tuple(
        Method(f"{algorithm} {cost}", algorithm, cost)
        for algorithm in algorithms_of(name)
        for cost in COSTS
    )
    return SweepConfig(train=train, methods=methods, seeds=SEEDS)


def where(name: str, runs: Path) -> Path:
    """The run directory of one setting."""
    return runs / name.replace(" ", "_")


def run(options: Options) -> None:
    """All settings, one after the other."""
    for name in options.only or SETTINGS:
        size = (1600, 200) if options.smoke else (STEPS, 1000)
        episodes = 2 if options.smoke else EPISODES
        run_if_needed(config_of(name, *size), where(name, options.runs), episodes)


def measured(name: str, path: Path) -> dict[str, Any]:
    """The JSON of one setting that has been run."""
    config, facts = read_config(path, SweepConfig)
    methods = {method.label: method for method in config.methods}
    table = json.loads((path / "evaluation.json").read_text())["rows"]
    rows = [
        {
            "algorithm": methods[row["method"]].algorithm,
            "cost": methods[row["method"]].cost,
            "seed": row["seed"],
            "return": row["return_mean"],
            "ep_cost": row["cost_mean"],
            "violation_rate": row["violation_rate"],
        }
        for row in table
    ]
    scores = [
        {
            "algorithm": algorithm,
            "cost": cost,
            **{
                score: t_interval(
                    [
                        row[score]
                        for row in rows
                        if (row["algorithm"], row["cost"]) == (algorithm, cost)
                    ]
                )
                for score in ("return", "ep_cost", "violation_rate")
            },
        }
        for algorithm, cost in itertools.product(algorithms_of(name), COSTS)
    ]
    train = config.train
    return {
        "setting": name,
        "epochs": train.num_epochs,
        "worlds": train.num_worlds,
        "segments": train.segments_per_episode,
        "agent": dataclasses.asdict(train.agent),
        "facts": facts,
        "rows": rows,
        "scores": scores,
    }


def collect(options: Options) -> None:
    """JSON and table of the settings that have been run, now or before."""
    file = options.results / "learners.json"
    before = json.loads(file.read_text())["settings"] if file.exists() else []
    known = {entry["setting"]: entry for entry in before}
    for name in SETTINGS:
        path = where(name, options.runs)
        if (path / "evaluation.json").exists():
            known[name] = measured(name, path)
    settings = [known[name] for name in SETTINGS if name in known]
    result = {
        "command": "python experiments/learners.py run && "
        "python experiments/learners.py collect",
        "steps": STEPS,
        "episodes": EPISODES,
        "settings": settings,
    }
    options.results.mkdir(parents=True, exist_ok=True)
    file.write_text(compact(json.loads(json.dumps(result))) + "\n")
    (options.results / "learners.md").write_text(table(settings))


def table(settings: list[dict[str, Any]]) -> str:
    """One row a setting: return at share of violating episodes, means of the seeds."""
    names = ("extrinsic alone", "with a margin of 2x", "3x")
    titles = [f"{name} {cost}" for name in ("PPO-Lag", "CPO") for cost in names]
    lines = ["| setting | " + " | ".join(titles) + " |", "|---" * 7 + "|"]
    for run in settings:
        cells = []
        for row in run["scores"]:
            low, high = row["return"]["low"], row["return"]["high"]
            rate = row["violation_rate"]["mean"]
            cells.append(
                f"{row['return']['mean']:.1f} ({low:.1f} to {high:.1f}) at {rate:.0%}"
            )
        lines.append(f"| {run['setting']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    run_part("learners", __doc__, {"run": run, "collect": collect}, SETTINGS)
