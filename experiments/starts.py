"""Which random costs are useful, and what a short training tells of them.

    python experiments/starts.py run      # grids of costs, each one table of slots
    python experiments/starts.py collect  # JSON and table

A cost of `graded_start` is drawn by how loud it is where it begins to speak
(`quiet_cost`), how far it reaches (the percentile of typical places at which it
begins), how loud it is at the 85th percentile, and how steep its hidden units are. Here
all four are set, not drawn. Each cost trains both algorithms with three seeds of the
`laptop` preset's learner, beside the extrinsic cost alone and a margin of 3x.

The second table asks what makes a stage's ranking mean something: the rank correlation
(Spearman) of one seed's score after 40 or 48 epochs with the truth, which is how far
the other two seeds are from success at the end. Its last rule gives each cost a seed of
its own, drawn anew 200 times; the bars come from one more seed.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import Options, compact, run_if_needed, run_part
from learners import config_of

from autocost_jax.envs.env import make_env
from autocost_jax.rollout import typical_lidars
from autocost_jax.runs.config_files import read_metrics
from autocost_jax.runs.directory import run_facts
from autocost_jax.runs.sweep import Method, SweepConfig
from autocost_jax.search.starts import graded_start
from autocost_jax.search.success import shortfall

LEARNER = "32-32, multiplier from 0.5 at 0.01"  # of experiments/learners.py
EPOCHS, FITNESS, SEEDS = 80, 12, (0, 1, 2)
ALGORITHMS = ("ppo_lagrangian", "cpo")
METRICS = ("ep_return", "violating_worlds", "ep_cost")
# name -> (quiet_cost, percentile at which it begins, cost at the 85th percentile, scale
# of the hidden weights); a place in the list modulo KEYS gives a cost's random key
GRIDS: dict[str, list[tuple[float, float, float, float]]] = {
    "convex": [
        (1e-4, reach, loud, 8.0)
        for reach in (5.0, 20.0, 35.0, 50.0, 65.0, 78.0)
        for loud in (0.02, 0.1, 0.4, 0.95)
    ],
    "straight": [
        (quiet, reach, loud, 8.0)
        for reach in (40.0, 60.0)
        for loud in (0.15, 0.3, 0.6)
        for quiet in (1e-3, 1e-2)
    ],
    "steep": [
        (1e-2, reach, loud, scale)
        for scale in (8.0, 16.0, 32.0)
        for reach in (50.0, 62.0)
        for loud in (0.3, 0.5)
    ],
}
KEYS = {"convex": 24, "straight": 12, "steep": 4}
STAGES = (40, 48)  # lengths of a stage that are compared


def table_of(name: str, smoke: bool = False) -> SweepConfig:
    """The slots of one grid: the references, then its costs, with both algorithms."""
    train = config_of(LEARNER).train
    train = dataclasses.replace(train, num_epochs=EPOCHS)
    grid = GRIDS[name]
    if smoke:
        env = dataclasses.replace(train.env, num_steps=200)
        train = dataclasses.replace(train, env=env, num_worlds=2, num_epochs=2)
        grid = grid[:2]
    lidars = typical_lidars(make_env(train.env), jax.random.key(0))
    rows: list[tuple[str, str, Any]] = [
        ("extrinsic", "extrinsic", None),
        ("margin 3x", "extrinsic+safety_margin_3x", None),
    ]
    for i, (quiet, reach, loud, scale) in enumerate(grid):
        key = jax.random.key(1000 + i % KEYS[name])
        theta = graded_start(
            key, 1, scale, lidars,
            quiet_places=(reach, reach), loud_costs=(loud, loud), quiet_cost=quiet,
        )[0]  # fmt: skip
        values = tuple(map(float, theta))
        rows.append((label_of(*grid[i]), "extrinsic+intrinsic", values))
    methods = tuple(
        Method(f"{algorithm} {label}", algorithm, cost, 0.0, theta)
        for algorithm in ALGORITHMS
        for label, cost, theta in rows
    )
    return SweepConfig(train=train, methods=methods, seeds=SEEDS[: 2 if smoke else 3])


def label_of(quiet: float, reach: float, loud: float, scale: float) -> str:
    """What a cost is called in the table."""
    return f"{quiet:g} at {reach:g}, {loud:g} at 85, scale {scale:g}"


def run(options: Options) -> None:
    """All grids."""
    for name in options.only or GRIDS:
        table = table_of(name, options.smoke)
        run_if_needed(table, options.runs / name, num_episodes=100)


def histories(path: Path, num_seeds: int) -> dict[str, np.ndarray]:
    """`METRICS` of a grid's training, each [epochs, A, C, seeds]."""
    rows = read_metrics(path)
    return {
        metric: np.array([[row[f"{a}/{metric}"] for a in ALGORITHMS] for row in rows])
        .reshape(len(rows), len(ALGORITHMS), -1, num_seeds)
        for metric in METRICS
    }  # fmt: skip


def last(values: np.ndarray, after: int, fitness: int = FITNESS) -> np.ndarray:
    """Means [A, C, seeds] over the last epochs of so many."""
    return values[max(0, after - fitness) : after].mean(0)


def distance(
    values: dict[str, np.ndarray], after: int, seeds: list[int], logs: bool = False
) -> np.ndarray:
    """[C - 2] how far the costs are from success.

    With `logs` distances are counted in factors, else in shares as in `shortfall`.
    """
    ep_return = last(values["ep_return"], after)[..., seeds].mean(-1)
    rate = last(values["violating_worlds"], after)[..., seeds].mean(-1)
    costs = (rate[:, 2:], ep_return[:, 2:])
    if not logs:
        return np.asarray(shortfall(*costs, rate[:, 0], ep_return[:, 0]))
    left = np.maximum(costs[0], 0.01) / rate[:, :1]
    kept = np.maximum(costs[1] / ep_return[:, :1], 0.003)
    far = np.maximum(np.log(left / 0.25), 0) + np.maximum(np.log(0.3 / kept), 0)
    return far.sum(0)


def rank_correlations(values: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """How well one seed's score in a stage ranks the costs, by rule and length."""
    from scipy.stats import spearmanr

    end, num_seeds = len(values["ep_cost"]), values["ep_cost"].shape[-1]

    def of(score: Any, after: int) -> list[float]:
        found = []
        for seed in range(num_seeds):
            others = [other for other in range(num_seeds) if other != seed]
            truth = distance(values, end, others)
            found.append(float(spearmanr(score(after, seed), truth)[0]))  # pyright: ignore
        return found

    def own_seeds(after: int, draws: int = 200) -> float:
        """Each cost with one seed of its own against the truth of the others."""
        rng, found = np.random.default_rng(0), []
        seeds = range(num_seeds)
        apart = [[other for other in seeds if other != seed] for seed in seeds]
        truths = np.stack([distance(values, end, others) for others in apart])
        costs = np.arange(truths.shape[1])
        rate, ep_return = (
            last(values[name], after) for name in ("violating_worlds", "ep_return")
        )
        for _ in range(draws):
            mine, bars = (
                rng.integers(num_seeds, size=len(costs)),
                rng.integers(num_seeds),
            )
            score = shortfall(
                rate[:, 2 + costs, mine], ep_return[:, 2 + costs, mine],
                rate[:, 0, bars], ep_return[:, 0, bars],
            )  # fmt: skip
            found.append(spearmanr(score, truths[mine, costs])[0])  # pyright: ignore
        return float(np.mean(found))

    rules = {
        "extrinsic cost": lambda after, seed: last(values["ep_cost"], after)[
            :, 2:, seed
        ].mean(0),
        "success, in factors": lambda after, seed: distance(
            values, after, [seed], logs=True
        ),
        "success, in shares": lambda after, seed: distance(values, after, [seed]),
    }
    lengths = [after for after in STAGES if after < end]
    return [
        {"rule": rule, "epochs": after, "by_seed": of(score, after)}
        for rule, score in rules.items()
        for after in lengths
    ] + [
        {
            "rule": "success, in shares, a seed for each cost",
            "epochs": after,
            "by_seed": [own_seeds(after)],
        }
        for after in lengths
    ]


def summarise(name: str, values: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON of one grid."""
    end = len(values["ep_cost"])
    tables = {metric: last(values[metric], end) for metric in METRICS}
    labels = ["extrinsic", "margin 3x"]
    labels += [label_of(*cost) for cost in GRIDS[name]]
    rows = [
        {
            "cost": label,
            "algorithm": algorithm,
            **{m: tables[m][a, c].tolist() for m in METRICS},
        }
        for c, label in enumerate(labels[: tables["ep_cost"].shape[1]])
        for a, algorithm in enumerate(ALGORITHMS)
    ]
    ranks = rank_correlations(values)
    return {"grid": name, "epochs": end, "rows": rows, "rank_correlations": ranks}


def table(result: dict[str, Any]) -> str:
    """The tables of experiments/results/starts/starts.md."""
    lines = [
        "| begins | violations left, PPO-Lag; CPO | return kept | extrinsic cost per "
        "episode | both bars |",
        "|---|---|---|---|---|",
    ]
    for grid in result["grids"]:
        rows = grid["rows"]
        plain = {r["algorithm"]: r for r in rows if r["cost"] == "extrinsic"}
        for label in dict.fromkeys(row["cost"] for row in rows):
            mine = [row for row in rows if row["cost"] == label]

            def share(metric: str, mine: Any = mine, plain: Any = plain) -> list[float]:
                return [
                    np.mean(r[metric]) / np.mean(plain[r["algorithm"]][metric])
                    for r in mine
                ]

            left, kept = share("violating_worlds"), share("ep_return")
            cost = [np.mean(row["ep_cost"]) for row in mine]
            reached = max(left) <= 0.25 and min(kept) >= 0.3
            lines.append(
                f"| {label} ({grid['epochs']} epochs) | "
                f"{left[0]:.0%}; {left[1]:.0%} | {kept[0]:.0%}; {kept[1]:.0%} | "
                f"{cost[0]:.2f}; {cost[1]:.2f} | {'yes' if reached else 'no'} |"
            )
    lines += [
        "",
        "| a stage ranks by | after | rank correlation, seed by seed | mean |",
    ]
    lines.append("|---|---|---|---|")
    ranks = [rank for grid in result["grids"] for rank in grid["rank_correlations"]]
    for rule, after in dict.fromkeys((r["rule"], r["epochs"]) for r in ranks):
        found = [
            value
            for rank in ranks
            if (rank["rule"], rank["epochs"]) == (rule, after)
            for value in rank["by_seed"]
        ]
        seeds = ", ".join(f"{value:.2f}" for value in found)
        lines.append(f"| {rule} | {after} epochs | {seeds} | {np.mean(found):.2f} |")
    return "\n".join(lines) + "\n"


def collect(options: Options) -> None:
    """JSON and table of all grids."""
    num_seeds = 2 if options.smoke else len(SEEDS)
    grids = [
        summarise(name, histories(options.runs / name, num_seeds))
        for name in GRIDS
        if (options.runs / name / "evaluation.json").exists()
    ]
    write({"grids": grids, "learner": LEARNER}, options.results)


def write(result: dict[str, Any], results: Path) -> None:
    """starts.json and starts.md."""
    command = "python experiments/starts.py run && python experiments/starts.py collect"
    result = {"command": command, "seeds": SEEDS, "facts": run_facts(), **result}
    results.mkdir(parents=True, exist_ok=True)
    (results / "starts.json").write_text(compact(json.loads(json.dumps(result))) + "\n")
    (results / "starts.md").write_text(table(result))


if __name__ == "__main__":
    run_part("starts", __doc__, {"run": run, "collect": collect}, GRIDS)
