"""Does it train? Every robot, the random policies, and a limit that binds.

    python experiments/robots.py runs           # PPO, PPO-Lagrangian, CPO everywhere
    python experiments/robots.py beats-random   # PPO against policies that know nothing
    python experiments/robots.py limit25        # 25 steps in hazards per episode
    python experiments/robots.py collect        # JSON, tables, figures of what has run

Each part can be stopped and started again; finished runs are kept. `--only NAME ...`
takes some of a part's worlds, `--smoke` shrinks everything to a minute. Results are
written to experiments/results/robots/.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import REDUCED, Options, compact, run_if_needed, run_part, t_interval
from robots_tables import ALGORITHMS, draw, render

from autocost_jax import Agent, EnvConfig, TrainConfig, env_config, make_env, preset
from autocost_jax.files import write_atomic
from autocost_jax.population import make_agents, make_evaluator
from autocost_jax.runs.config_files import to_json
from autocost_jax.runs.directory import read_config, read_metrics, run_facts
from autocost_jax.runs.policies import EVALUATION, eval_summary
from autocost_jax.runs.sweep import AlgorithmName, Method, SweepConfig, sweep_slots
from autocost_jax.train import init_learner


class LimitTable(NamedTuple):
    """Size of a table with a limit that binds.

    Attributes:
      algorithms: its methods.
      worlds: of a slot.
      epochs: of 1000 steps a world.
      seeds: one slot each.
    """

    algorithms: tuple[AlgorithmName, ...]
    worlds: int
    epochs: int
    seeds: tuple[int, ...]


# Worlds a slot: 3 algorithms x RUN_SEEDS x worlds x RUN_EPOCHS x 1000 env steps. With
# one world there is little to learn from: those only show that nothing breaks.
RUN_WORLDS = {
    "Goal-Hazard-Point": 8,
    "Goal-Hazard-Car": 4,
    "Goal-Hazard-Doggo": 2,
    "Goal-Pillar-Point": 4,
    "Goal-Pillar-Car": 2,
    "Goal-Pillar-Doggo": 1,
    "Push-Hazard-Point": 2,
    "Push-Hazard-Car": 1,
    "Push-Hazard-Doggo": 1,
    "Push-Pillar-Point": 2,
    "Push-Pillar-Car": 1,
    "Push-Pillar-Doggo": 1,
}
RUN_EPOCHS, RUN_SEEDS, RUN_EPISODES = 20, (0, 1), 2

# Worlds a slot and epochs of SEEDS, then EPISODES fresh episodes of three policies a
# seed.
RANDOM_SIZES = {
    "Goal-Hazard-Point": (8, 60),
    "Goal-Hazard-Car": (8, 60),
    "Goal-Pillar-Point": (8, 40),
    "Goal-Pillar-Car": (4, 60),
}
SEEDS, EPISODES = (0, 1, 2), 50

# 25 steps in hazards per episode. All algorithms; PPO-Lagrangian for long enough that
# its multiplier comes to rest; CPO with enough episodes an epoch for a cost gradient.
LIMIT, LIMIT_EPISODES = 25.0, 100
LIMIT_TABLES = {
    "limit25": LimitTable(ALGORITHMS, worlds=16, epochs=100, seeds=(0, 1, 2)),
    "limit25_long": LimitTable(("ppo_lagrangian",), 8, 300, (0, 1, 2)),
    "limit25_wide": LimitTable(("cpo",), 64, 80, (0, 1)),
}

CURVES = ("ep_return", "ep_cost", "kl", "multiplier", "case", "accepted")
NO_STATE = ("intrinsic_far", "intrinsic_near")  # NaN where no such state was visited


def run_all(options: Options) -> None:
    """All algorithms on every robot, limit 0: nothing may become non-finite."""
    methods = tuple(Method(name, name) for name in ALGORITHMS)
    for name, worlds in chosen(RUN_WORLDS, options).items():
        train = sized(env_config(name), worlds, RUN_EPOCHS, options)
        config = SweepConfig(train, methods, RUN_SEEDS)
        run_if_needed(config, options.runs / f"runs_{name}", RUN_EPISODES)


def run_beats_random(options: Options) -> None:
    """PPO, and on the same fresh layouts its untrained networks and uniform actions."""
    episodes = 2 if options.smoke else EPISODES
    for name, (worlds, epochs) in chosen(RANDOM_SIZES, options).items():
        train = sized(env_config(name), worlds, epochs, options)
        config = SweepConfig(train, (Method("ppo", "ppo"),), SEEDS)
        path = options.runs / f"random_{name}"
        run_if_needed(config, path, episodes)
        if not (path / "random.json").exists():
            rows = evaluate_random(config, episodes)
            text = json.dumps(to_json(rows), indent=1, allow_nan=False)
            write_atomic(path / "random.json", text.encode() + b"\n")


def run_limit(options: Options) -> None:
    """A limit of 25 on the number of steps in hazards, and PPO without a limit."""
    env = dataclasses.replace(env_config("Goal-Hazard-Point"), constrain_indicator=True)
    episodes = 2 if options.smoke else LIMIT_EPISODES
    for name, (algorithms, worlds, epochs, seeds) in LIMIT_TABLES.items():
        train = sized(env, worlds, epochs, options)
        methods = tuple(Method(name, name, limit=LIMIT) for name in algorithms)
        config = SweepConfig(train, methods, seeds)
        run_if_needed(config, options.runs / name, episodes)


def chosen(sizes: dict[str, Any], options: Options) -> dict[str, Any]:
    """The worlds of a part that the command line asks for."""
    return {
        name: size
        for name, size in sizes.items()
        if not options.only or name in options.only
    }


def sized(env: EnvConfig, worlds: int, epochs: int, options: Options) -> TrainConfig:
    """The reduced learner in one world, or the `smoke` preset's."""
    if options.smoke:
        env = dataclasses.replace(env, num_steps=50)
        return dataclasses.replace(preset("smoke").train, env=env)
    return TrainConfig(env=env, agent=REDUCED, num_worlds=worlds, num_epochs=epochs)


def evaluate_random(config: SweepConfig, num_episodes: int) -> list[dict[str, Any]]:
    """Scores of the untrained networks and of uniform actions, one row a seed.

    They meet the layouts on which `run_sweep` scores the trained policies.
    """
    env = make_env(config.train.env)
    (learner,) = make_agents(("ppo_lagrangian",), config.train, env)
    (slots,) = sweep_slots(config)
    fresh = jax.vmap(lambda slot: init_learner(learner, slot).agent)(slots)

    def policy(state: Any, obs: jax.Array, key: jax.Array, deterministic: bool = False):
        network, is_uniform, seed = state
        key = jax.random.fold_in(key, seed)
        shape = (*obs.shape[:-1], env.action_size)
        uniform = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        return jnp.where(
            is_uniform, uniform, learner.policy(network, obs, key, deterministic)
        )

    kinds = [(name, seed) for name in ("untrained", "uniform") for seed in config.seeds]
    states = (
        jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), fresh),
        jnp.asarray([name == "uniform" for name, _ in kinds]),
        jnp.asarray([seed for _, seed in kinds]),
    )
    agent = Agent(learner.init, policy, learner.update)
    key = jax.random.key(EVALUATION)
    results, _ = make_evaluator(env, agent, num_episodes)(states, key)
    return [
        {"policy": name, "seed": seed}
        | eval_summary(jax.tree.map(lambda leaf, i=i: leaf[i], results))
        for i, (name, seed) in enumerate(kinds)
    ]


def collect_run(path: Path) -> dict[str, Any]:
    """What was run, whether anything broke, and the curves of each slot."""
    config, facts = read_config(path, SweepConfig)
    rows = read_metrics(path)
    broken = failed = frozen = 0
    for row in rows:
        for name, values in row.items():
            key = name.partition("/")[2]
            bad = 0 if key in NO_STATE else np.sum(~np.isfinite(values))
            broken += int(bad)
            failed += int(np.sum(values)) if key == "failed_worlds" else 0
    slots = []
    for group in config.algorithms:
        frozen += int(np.sum(rows[-1][f"{group}/frozen"]))
        for index, (method, seed) in enumerate(config.group(group)):
            slot: dict[str, Any] = {"method": method.label, "seed": seed}
            for name in CURVES:
                key = f"{group}/{name}"
                if key in rows[0]:
                    slot[name] = [round(float(row[key][index]), 4) for row in rows]
            slots.append(slot)
    train = config.train
    return {
        "env": train.env.name,
        "worlds": train.num_worlds,
        "epochs": len(rows),
        "steps_a_slot": train.num_worlds * train.env.num_steps * len(rows),
        "seeds": list(config.seeds),
        "limits": {method.label: method.limit for method in config.methods},
        "non_finite_numbers": broken,
        "failed_worlds": failed,
        "frozen_slots": frozen,
        "facts": facts,
        "slots": slots,
    }


def collect_random(path: Path) -> dict[str, Any]:
    """Returns of trained and random policies, differences seed by seed."""
    trained = json.loads((path / "evaluation.json").read_text())["rows"]
    others = json.loads((path / "random.json").read_text())
    returns = {"ppo": [row["return_mean"] for row in trained]}
    for name in ("untrained", "uniform"):
        rows = [row for row in others if row["policy"] == name]
        returns[name] = [row["return_mean"] for row in rows]
    run = collect_run(path)
    return run | {
        "episodes": trained[0]["episodes"],
        "returns": returns,
        "difference": {
            name: t_interval(np.subtract(returns["ppo"], returns[name]))
            for name in ("untrained", "uniform")
        },
    }


def spread(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Mean, lowest and highest of one value a seed."""
    values = np.asarray(values, np.float64)
    return {"mean": values.mean(), "low": values.min(), "high": values.max()}


def collect_limit(path: Path) -> dict[str, Any]:
    """Whether cost settles near the limit, and how the learners got there.

    "Last" is the last fifth of the epochs; low and high are the extreme seeds.
    """
    run = collect_run(path)
    evaluated = json.loads((path / "evaluation.json").read_text())
    last = max(1, run["epochs"] // 5)
    methods = {}
    for name, limit in run["limits"].items():
        slots = [slot for slot in run["slots"] if slot["method"] == name]
        scores = [row for row in evaluated["rows"] if row["method"] == name]
        curves = {
            key: np.asarray([slot[key] for slot in slots])
            for key in CURVES
            if key in slots[0]
        }
        multiplier = curves["multiplier"].mean(0)
        row: dict[str, Any] = {
            "limit": limit,
            "last_cost": spread(curves["ep_cost"][:, -last:].mean(1)),
            "last_return": spread(curves["ep_return"][:, -last:].mean(1)),
            "fresh_cost": spread([row["cost_mean"] for row in scores]),
            "fresh_return": spread([row["return_mean"] for row in scores]),
            "kl": float(curves["kl"].mean()),
            "multiplier": [multiplier[0], multiplier.max(), multiplier[-1]],
        }
        if "case" in curves:
            case, accepted = curves["case"], curves["accepted"]
            row["cases"] = [float((case == k).mean()) for k in range(5)]
            row["accepted"] = float(accepted.mean())
            row["accepted_in_case"] = [
                float(accepted[case == k].mean()) if (case == k).any() else None
                for k in range(5)
            ]
        methods[name] = row
    episodes = evaluated["episodes"]
    return run | {"last_epochs": last, "episodes": episodes, "methods": methods}


def collect(options: Options) -> None:
    """Write the JSON, the tables and the figures of whatever has been run."""
    options.results.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {
        "commands": [f"python experiments/robots.py {part}" for part in PARTS],
        "facts": run_facts(),
        "update": "nets 64-64, 6 passes x 8 minibatches (reduced scale)",
        "runs": {},
        "beats_random": {},
        "limit25": {},
    }
    for name in RUN_WORLDS:
        path = options.runs / f"runs_{name}"
        if (path / "evaluation.json").exists():
            result["runs"][name] = collect_run(path)
    for name in RANDOM_SIZES:
        path = options.runs / f"random_{name}"
        if (path / "random.json").exists():
            result["beats_random"][name] = collect_random(path)
    for name in LIMIT_TABLES:
        path = options.runs / name
        if (path / "evaluation.json").exists():
            result["limit25"][name] = collect_limit(path)
    file = options.results / "robots.json"
    file.write_text(compact(to_json(result)) + "\n")
    result = json.loads(file.read_text())
    file.with_suffix(".md").write_text(render(result))
    draw(result, options.results)
    print(file)


PARTS: dict[str, Callable[[Options], None]] = {
    "runs": run_all,
    "beats-random": run_beats_random,
    "limit25": run_limit,
    "collect": collect,
}


if __name__ == "__main__":
    run_part("robots", __doc__, PARTS, RUN_WORLDS)
