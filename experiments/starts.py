"""Which random costs are useful, and what a short training tells of them.

    python experiments/starts.py run      # a grid of costs, one table of slots
    python experiments/starts.py collect  # JSON and table

A cost of `graded_start` is drawn by how far it reaches (the percentile of typical
places at which it begins to speak, at 0.01) and how loud it is at the 85th percentile.
Here both are set, not drawn. Each cost trains both algorithms with three seeds of the
`laptop` preset's learner, for as long as its finalists, beside the extrinsic cost alone
and a margin of 3x.

The second table asks what makes a stage's ranking mean something: the rank correlation
(Spearman) of one seed's score after so many epochs with the truth, which is how far the
other two seeds are from a search's aims at the end. Its last rule gives each cost a
seed of its own, drawn anew 200 times; the reference is of one more.

The third compares ways to spend the same number of epochs on twelve costs: all of them
for 36, or successive halving, which drops the worst once or twice and trains the rest
for longer. What counts is the truth of the cost that a way comes out with.
"""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import Options, compact, run_if_needed, run_part

from autocost_jax.config import TrainConfig, preset
from autocost_jax.envs.env import make_env
from autocost_jax.rollout import typical_lidars
from autocost_jax.runs.config_files import read_metrics
from autocost_jax.runs.directory import read_config
from autocost_jax.runs.sweep import Method, SweepConfig
from autocost_jax.search.starts import graded_start
from autocost_jax.search.success import is_success, shortfall

SEEDS = (0, 1, 2)
ALGORITHMS = ("ppo_lagrangian", "cpo")
METRICS = ("ep_return", "violating_worlds", "ep_cost")
REACHES = (50.0, 57.0, 64.0, 71.0)  # percentiles at which a cost begins
LOUDNESS = (0.12, 0.25, 0.5)  # at the 85th percentile
GRID = tuple(itertools.product(REACHES, LOUDNESS))
PLAIN = ("extrinsic", "margin 3x")  # stand before the grid's costs
STAGES = (24, 36, 48)  # lengths of a stage that are compared
# Each way: costs that are left, and the epoch to which they are trained.
WAYS = {
    "all for 36 epochs": ((12, 36),),
    "12 for 18, 6 for 36, 3 for 72": ((12, 18), (6, 36), (3, 72)),
    "12 for 24, 4 for 60": ((12, 24), (4, 60)),
}


def laptop(smoke: bool) -> TrainConfig:
    """The training of the preset's finalists."""
    config = preset("laptop")
    train = dataclasses.replace(config.train, num_epochs=config.final_epochs)
    if smoke:
        env = dataclasses.replace(train.env, num_steps=200)
        train = dataclasses.replace(train, env=env, num_worlds=2, num_epochs=2)
    return train


def table_of(smoke: bool = False) -> SweepConfig:
    """The slots: the references, then the grid's costs, with both algorithms."""
    train = laptop(smoke)
    lidars = typical_lidars(make_env(train.env), jax.random.key(0))
    rows: list[tuple[str, str, Any]] = [
        (PLAIN[0], "extrinsic", None),
        (PLAIN[1], "extrinsic+safety_margin_3x", None),
    ]
    for i, (reach, loud) in enumerate(GRID[:2] if smoke else GRID):
        theta = graded_start(
            jax.random.key(i), 1, preset("laptop").init_std, lidars,
            quiet_places=(reach, reach), loud_costs=(loud, loud),
        )[0]  # fmt: skip
        values = tuple(map(float, theta))
        rows.append((label_of(reach, loud), "extrinsic+intrinsic", values))
    methods = tuple(
        Method(f"{algorithm} {label}", algorithm, cost, 0.0, theta)
        for algorithm in ALGORITHMS
        for label, cost, theta in rows
    )
    return SweepConfig(train=train, methods=methods, seeds=SEEDS)


def label_of(reach: float, loud: float) -> str:
    """What a cost is called in the table."""
    return f"at {reach:g}, {loud:g} at 85"


def run(options: Options) -> None:
    """The grid."""
    run_if_needed(table_of(options.smoke), options.runs, num_episodes=100)


def histories(path: Path) -> dict[str, np.ndarray]:
    """`METRICS` of the training, each [epochs, A, C, seeds]."""
    rows = read_metrics(path)
    return {
        metric: np.array([[row[f"{a}/{metric}"] for a in ALGORITHMS] for row in rows])
        .reshape(len(rows), len(ALGORITHMS), -1, len(SEEDS))
        for metric in METRICS
    }  # fmt: skip


def last(values: np.ndarray, after: int) -> np.ndarray:
    """Means [A, C, seeds] over the preset's fitness epochs, the last of so many."""
    return values[max(0, after - preset("laptop").fitness_epochs) : after].mean(0)


def distance(values: dict[str, np.ndarray], after: int, seeds: list[int]) -> np.ndarray:
    """[C - 2] how far the costs are from what a search aims at."""
    ep_return = last(values["ep_return"], after)[..., seeds].mean(-1)
    rate = last(values["violating_worlds"], after)[..., seeds].mean(-1)
    costs = (rate[:, 2:], ep_return[:, 2:])
    return np.asarray(shortfall(*costs, rate[:, 0], ep_return[:, 0]))


def rank_correlations(values: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """How well one seed's score in a stage ranks the costs, by rule and length."""
    from scipy.stats import spearmanr

    end, seeds = len(values["ep_cost"]), range(len(SEEDS))
    truths = np.stack(
        [distance(values, end, [o for o in seeds if o != seed]) for seed in seeds]
    )
    costs = np.arange(truths.shape[1])

    def correlation(score: Any, truth: np.ndarray) -> float:
        return float(spearmanr(score, truth)[0])  # pyright: ignore

    def by_cost(after: int, seed: int) -> np.ndarray:
        return last(values["ep_cost"], after)[:, 2:, seed].mean(0)

    def by_distance(after: int, seed: int) -> np.ndarray:
        return distance(values, after, [seed])

    def own_seeds(after: int, draws: int = 200) -> float:
        """Each cost with one seed of its own against the truth of the others."""
        rng, found = np.random.default_rng(0), []
        names = ("violating_worlds", "ep_return")
        rate, ep_return = (last(values[name], after) for name in names)
        for _ in range(draws):
            mine = rng.integers(len(seeds), size=len(costs))
            plain = rng.integers(len(seeds))
            score = shortfall(
                rate[:, 2 + costs, mine], ep_return[:, 2 + costs, mine],
                rate[:, 0, plain], ep_return[:, 0, plain],
            )  # fmt: skip
            found.append(correlation(score, truths[mine, costs]))
        return float(np.mean(found))

    shared = {"extrinsic cost": by_cost, "distance from the aims": by_distance}
    lengths = [after for after in STAGES if after < end]
    found = [
        (rule, after, [correlation(score(after, s), truths[s]) for s in seeds])
        for rule, score in shared.items()
        for after in lengths
    ]
    own = "distance, a seed for each cost"
    found += [(own, after, [own_seeds(after)]) for after in lengths]
    return [
        {"rule": rule, "epochs": after, "by_seed": by_seed}
        for rule, after, by_seed in found
    ]


def epochs_of(way: tuple[tuple[int, int], ...]) -> int:
    """Epochs of training that a way spends on all costs together."""
    starts = (0, *(end for _, end in way))
    return sum(
        count * (end - start) for (count, end), start in zip(way, starts, strict=False)
    )


def chosen(
    values: dict[str, np.ndarray], way: tuple[tuple[int, int], ...], seed: int
) -> int:
    """The cost that a way comes out with, one training seed deciding."""
    left = np.arange(values["ep_cost"].shape[2] - len(PLAIN))
    for (_, end), (keep, _) in zip(way, (*way[1:], (1, 0)), strict=True):
        score = distance(values, end, [seed])[left]
        left = left[np.argsort(score, kind="stable")[:keep]]
    return int(left[0])


def ways(values: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """The truth of each way's choice by the other seeds, beside the mean and the best.

    The choice is made with the seed at its place, the truth is that of the two others
    after the whole training.
    """
    end, seeds = len(values["ep_cost"]), range(len(SEEDS))
    truths = [distance(values, end, [o for o in seeds if o != s]) for s in seeds]
    rows = [
        {"way": "any of them", "by_seed": [float(truth.mean()) for truth in truths]},
        {"way": "the best of them", "by_seed": [float(np.min(t)) for t in truths]},
    ]
    for name, way in WAYS.items():
        picks = [chosen(values, way, seed) for seed in seeds]
        by_seed = [float(truths[s][pick]) for s, pick in zip(seeds, picks, strict=True)]
        rows.append({"way": name, "by_seed": by_seed})
    return rows


def summarise(values: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON of the grid."""
    end = len(values["ep_cost"])
    tables = {metric: last(values[metric], end) for metric in METRICS}
    labels = [*PLAIN, *(label_of(*cost) for cost in GRID)]
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
    found = {"epochs": end, "rows": rows, "rank_correlations": ranks}
    longest = max(end for way in WAYS.values() for _, end in way)
    return found | ({"ways": ways(values)} if end >= longest else {})


def table(result: dict[str, Any]) -> str:
    """The tables of experiments/results/starts/starts.md."""
    lines = [
        "| begins | violations left, PPO-Lag; CPO | return kept | extrinsic cost per "
        "episode | both bars |",
        "|---|---|---|---|---|",
    ]
    rows = result["rows"]
    plain = {row["algorithm"]: row for row in rows if row["cost"] == PLAIN[0]}
    for label in dict.fromkeys(row["cost"] for row in rows):
        mine = [row for row in rows if row["cost"] == label]
        left, kept, cost, reached = [], [], [], True
        for row in mine:
            pair = row, plain[row["algorithm"]]
            rates = [float(np.mean(each["violating_worlds"])) for each in pair]
            returns = [float(np.mean(each["ep_return"])) for each in pair]
            left.append(f"{rates[0] / rates[1]:.0%}")
            kept.append(f"{returns[0] / returns[1]:.0%}")
            cost.append(f"{np.mean(row['ep_cost']):.2f}")
            reached &= is_success(rates[0], returns[0], rates[1], returns[1])
        lines.append(
            f"| {label} | {'; '.join(left)} | {'; '.join(kept)} | {'; '.join(cost)} | "
            f"{'yes' if reached else 'no'} |"
        )
    lines += [
        "",
        "| a stage ranks by | after | rank correlation, seed by seed | mean |",
        "|---|---|---|---|",
    ]
    for rank in result["rank_correlations"]:
        seeds = ", ".join(f"{value:.2f}" for value in rank["by_seed"])
        lines.append(
            f"| {rank['rule']} | {rank['epochs']} epochs | {seeds} | "
            f"{np.mean(rank['by_seed']):.2f} |"
        )
    if "ways" in result:
        lines += [
            "",
            "| 432 epochs on twelve costs | distance of the choice from the aims, seed "
            "by seed | mean |",
            "|---|---|---|",
        ]
    for row in result.get("ways", ()):
        seeds = ", ".join(f"{value:.2f}" for value in row["by_seed"])
        lines.append(f"| {row['way']} | {seeds} | {np.mean(row['by_seed']):.2f} |")
    return "\n".join(lines) + "\n"


def collect(options: Options) -> None:
    """JSON and table of the grid."""
    command = "python experiments/starts.py run && python experiments/starts.py collect"
    config, facts = read_config(options.runs, SweepConfig)
    agent = dataclasses.asdict(config.train.agent)
    result = {"command": command, "seeds": SEEDS, "facts": facts, "agent": agent}
    result |= summarise(histories(options.runs))
    options.results.mkdir(parents=True, exist_ok=True)
    text = compact(json.loads(json.dumps(result)))
    (options.results / "starts.json").write_text(text + "\n")
    (options.results / "starts.md").write_text(table(result))


if __name__ == "__main__":
    run_part("starts", __doc__, {"run": run, "collect": collect}, ())
