"""What learner settings are worth at equal env steps, from REDUCED to the presets'.

    python experiments/learners.py run                 # all settings, one process each
    python experiments/learners.py run --only NAME     # one of them
    python experiments/learners.py collect             # JSON and table

Every setting trains PPO-Lagrangian and CPO on Goal-Hazard-Point in closed form for
512,000 env steps a slot with five seeds and three costs: the extrinsic one alone, and
with a margin of 2x and 3x. Scores are of 200 fresh episodes a seed, actions sampled.
"""

import argparse
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import REDUCED, compact, t_interval

from autocost_jax.agents.base import actor
from autocost_jax.commandline import use_devices
from autocost_jax.config import EnvConfig, TrainConfig
from autocost_jax.envs.env import make_env
from autocost_jax.evaluate import evaluate
from autocost_jax.population import make_agents, make_population
from autocost_jax.runs.directory import run_facts
from autocost_jax.runs.sweep import Method, SweepConfig, sweep_slots

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
STRICT = STILL | {"multiplier_lr": 0.02, "violation_factor": 1.5}
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
    "and a multiplier at 0.02, CPO's violation x 1.5": (8, 1, STRICT),  # of `laptop`
}
ALGORITHMS = ("ppo_lagrangian", "cpo")


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
        for algorithm in ("ppo_lagrangian", "cpo")
        for cost in COSTS
    )
    return SweepConfig(train=train, methods=methods, seeds=SEEDS)


def run_one(name: str, out: Path, smoke: bool) -> None:
    """Train and score one setting; writes NAME.json."""
    config = config_of(name, 1600, 200) if smoke else config_of(name)
    devices = use_devices(None)
    train = config.train
    env = make_env(train.env)
    agents = make_agents(config.algorithms, train, env)
    population = make_population(env, agents, train, devices=devices)
    slots = sweep_slots(config)
    state = population.init(slots)
    start = time.monotonic()
    for epoch in range(train.num_epochs):
        state, metrics = population.chunk(state, slots, epoch)
        if epoch == 0:
            jax.block_until_ready(metrics)
            start = time.monotonic()
    jax.block_until_ready(metrics)
    seconds = time.monotonic() - start
    score = jax.jit(
        jax.vmap(
            lambda state, key: evaluate(env, agents[0], state, key, EPISODES),
            in_axes=(0, None),
        )
    )
    template = agents[0].init(jax.random.key(0))
    rows = []
    for algorithm, learner in zip(config.algorithms, state.learners, strict=True):
        group = config.group(algorithm)
        acting = actor(jax.device_get(learner.agent))
        size = len(group)
        states = jax.tree.map(lambda x, n=size: np.stack([x] * n), template)
        result = score(states.replace(**acting._asdict()), jax.random.key(99))
        for index, (method, seed) in enumerate(group):
            rows.append(
                {
                    "algorithm": algorithm,
                    "cost": method.cost,
                    "seed": seed,
                    "return": float(result.ep_return[index].mean()),
                    "ep_cost": float(result.ep_cost[index].mean()),
                    "violation_rate": float(result.violation_rate[index]),
                }
            )
    done = {"setting": name, "epochs": train.num_epochs, "seconds": seconds}
    done |= {"agent": dataclasses.asdict(train.agent), "worlds": train.num_worlds}
    done |= {"segments": train.segments_per_episode, "rows": rows, "facts": run_facts()}
    text = json.dumps(done, indent=1, default=str)
    (out / f"{name.replace(' ', '_')}.json").write_text(text)
    print(f"{name}: {seconds:.0f} s", flush=True)


def run_all(names: list[str], out: Path, smoke: bool) -> None:
    """All settings at once on a GPU, one after the other on a CPU."""
    is_gpu = Path("/dev/nvidia0").exists()
    environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    running = []
    for name in names:
        command = [sys.executable, __file__, "run", "--only", name, "--out", str(out)]
        command += ["--smoke"] if smoke else []
        process = subprocess.Popen(command, env=environment)
        running.append(process)
        if not is_gpu:
            process.wait()
    failed = [p.args for p in running if p.wait()]
    if failed:
        raise SystemExit(f"{len(failed)} settings failed: {failed}")


def collect(out: Path, results: Path) -> None:
    """JSON and table of the settings that have been run."""
    files = [out / f"{name.replace(' ', '_')}.json" for name in SETTINGS]
    done = [json.loads(file.read_text()) for file in files if file.exists()]
    settings = []
    for run in done:
        scores = []
        for algorithm, cost in itertools.product(ALGORITHMS, COSTS):
            rows = [
                row
                for row in run["rows"]
                if (row["algorithm"], row["cost"]) == (algorithm, cost)
            ]
            scores.append(
                {
                    "algorithm": algorithm,
                    "cost": cost,
                    "return": t_interval([row["return"] for row in rows]),
                    "ep_cost": t_interval([row["ep_cost"] for row in rows]),
                    "violation_rate": t_interval(
                        [row["violation_rate"] for row in rows]
                    ),
                }
            )
        kept = ("setting", "epochs", "worlds", "segments", "agent", "facts", "rows")
        settings.append({**{key: run[key] for key in kept}, "scores": scores})
    result = {
        "command": "python experiments/learners.py run && "
        "python experiments/learners.py collect",
        "steps": STEPS,
        "episodes": EPISODES,
        "settings": settings,
    }
    results.mkdir(parents=True, exist_ok=True)
    (results / "learners.json").write_text(compact(result) + "\n")
    (results / "learners.md").write_text(table(settings))


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


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("run", "collect"))
    parser.add_argument("--only", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--out", type=Path, default=Path("runs/learners"))
    results = Path("experiments/results/learners")
    parser.add_argument("--results", type=Path, default=results)
    parser.add_argument("--smoke", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.part == "collect":
        collect(args.out, args.results)
        return
    if len(args.only) == 1:
        run_one(args.only[0], args.out, args.smoke)
    else:
        run_all(args.only, args.out, args.smoke)


if __name__ == "__main__":
    main()
