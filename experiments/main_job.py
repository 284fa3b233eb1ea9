"""The main job, measured: does it find costs that make agents safe and useful?

    python experiments/main_job.py run       # the default job, 3 seeds, their controls
    python experiments/main_job.py validate  # the best costs again, with 5 other seeds
    python experiments/main_job.py collect   # JSON, table, figure

The presets were tuned while seeds 0, 1 and 2 were looked at. `--only untuned` does the
same with seeds 3, 4 and 5, on which nothing has been tuned, and without controls.

Each search seed is paired with one whose elites are drawn at random under the same
keys: both meet the same layouts, so that their last stages can be compared. Every run
can be stopped and started again; finished ones are kept.

Tests, stated before the runs:

- The mean extrinsic cost of the candidates falls from the first stage to the last: the
  95 % bootstrap interval of the fall, over candidates, lies above 0; for each search,
  and for the candidates of all searches together. The last stage ends below the
  control's and keeps a quarter of the reference's return.
- Of the best cost's agents, trained with fresh seeds for the preset's length, at most a
  quarter as many episodes violate as with the extrinsic cost alone, at 30 % of its
  return or more, for each algorithm. The search chose this cost among its finalists by
  these very agents. So the same is asked of five more seeds that no search has seen,
  trained with all best costs and references side by side.
"""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from common import Options, run_if_needed, run_part

from autocost_jax.costs import load_cost
from autocost_jax.files import load_arrays
from autocost_jax.runs.config_files import read_document, to_json
from autocost_jax.runs.directory import list_stages, read_config
from autocost_jax.runs.outcome import reaches_bars, row_of
from autocost_jax.runs.sweep import Method, SweepConfig
from autocost_jax.search.stages import REFERENCES
from autocost_jax.search.success import is_success

SEEDS = {"tuned": (0, 1, 2), "untuned": (3, 4, 5)}
VALIDATION_SEEDS = (100, 101, 102, 103, 104)
EPISODES = 100
MARGIN = "safety_margin_3x"
WORDS = {True: "yes", False: "no", None: "not measured"}
LAST_RETURN = 0.25  # of the reference's, in the last stage


def search_dir(runs: Path, selection: str, seed: int) -> Path:
    """Where one search lives."""
    return runs / f"{selection}_{seed}"


def group_of(options: Options) -> str:
    """Which search seeds are meant."""
    if len(options.only) > 1:
        raise SystemExit("main_job: --only takes tuned or untuned, not both")
    return options.only[0] if options.only else "tuned"


def run(options: Options) -> None:
    """The default job as a user runs it, and its controls, which need no finalists."""
    group = group_of(options)
    for selection in ("paper", "random") if group == "tuned" else ("paper",):
        for seed in SEEDS[group]:
            out = search_dir(options.runs, selection, seed)
            if (out / "summary.json").exists():
                continue
            command = [sys.executable, "-m", "autocost_jax.evolve", "--out", str(out)]
            own = ["--seed", str(seed), *(["--preset", "smoke"] * options.smoke)]
            if selection == "random":
                own += ["--selection", "random", "--num-finalists", "0"]
            started = (out / "config.yaml").exists()
            subprocess.run([*command, *(["--resume"] if started else own)], check=True)


def finished(options: Options) -> list[Path]:
    """The searches that have ended."""
    seeds = SEEDS[group_of(options)]
    paths = [search_dir(options.runs, "paper", seed) for seed in seeds]
    return [path for path in paths if (path / "summary.json").exists()]


def stages_of(path: Path) -> list[dict[str, np.ndarray]]:
    """The arrays of a run's stages."""
    return [dict(load_arrays(file)) for file in list_stages(path).values()]


def bootstrap_difference(first: np.ndarray, last: np.ndarray) -> list[float]:
    """95 % interval of mean(first) - mean(last) over resampled candidates."""
    rng = np.random.default_rng(0)

    def means(values: np.ndarray) -> np.ndarray:
        index = rng.integers(len(values), size=(10_000, len(values)))
        return values[index].mean(1)

    low, high = np.percentile(means(first) - means(last), [2.5, 97.5])
    return [float(low), float(high)]


def fall_of(paths: list[Path]) -> dict[str, Any]:
    """The fall over all candidates of some searches together."""
    stages = [stages_of(path) for path in paths]
    first, last = (
        np.concatenate([own[place]["cost"] for own in stages]) for place in (0, -1)
    )
    interval = bootstrap_difference(first, last)
    fall = float(first.mean() - last.mean())
    return {"fall": fall, "fall_95": interval, "falls": interval[0] > 0}


def validation_table(papers: list[Path]) -> SweepConfig:
    """The best costs and both references, with seeds that no search has."""
    config, _ = read_config(papers[0])
    train = dataclasses.replace(
        config.train, num_epochs=config.epochs_of(config.num_stages)
    )
    costs: dict[str, tuple[str, Any]] = {
        label: (cost, None) for label, cost in REFERENCES.items()
    }
    for path in papers:
        theta = tuple(map(float, load_cost(path / "cost.npz")))
        costs[path.name] = ("extrinsic+intrinsic", theta)
    methods = tuple(
        Method(f"{algorithm} {label}", algorithm, cost, 0.0, theta)
        for algorithm in config.algorithms
        for label, (cost, theta) in costs.items()
    )
    return SweepConfig(train=train, methods=methods, seeds=VALIDATION_SEEDS)


def validate(options: Options) -> None:
    """Train and score the table of all finished searches."""
    table = validation_table(finished(options))
    run_if_needed(table, validation_dir(options), num_episodes=EPISODES)


def validation_dir(options: Options) -> Path:
    """Where the best costs are trained again."""
    return options.runs / ("validation" + "_untuned" * (group_of(options) != "tuned"))


def validation_rows(papers: list[Path], path: Path) -> list[dict[str, Any]]:
    """The margin and each best cost against the bars, by means over the seeds."""
    file = path / "evaluation.json"
    table = json.loads(file.read_text())["rows"] if file.exists() else []

    def of(algorithm: str, label: str) -> list[list[float]]:
        rows = [row for row in table if row["method"] == f"{algorithm} {label}"]
        return [
            [row[name] for row in rows] for name in ("violation_rate", "return_mean")
        ]

    out = []
    for algorithm in read_config(papers[0])[0].algorithms if table else ():
        plain = of(algorithm, "extrinsic")
        for label in (MARGIN, *(paper.name for paper in papers)):
            mine = of(algorithm, label)
            means = [float(np.mean(values)) for values in (*mine, *plain)]
            out.append(
                {
                    "algorithm": algorithm,
                    "cost": label,
                    "violation_rate": mine[0],
                    "return": mine[1],
                    "reference": {"violation_rate": plain[0], "return": plain[1]},
                    "violations_left": means[0] / means[2],
                    "return_kept": means[1] / means[3],
                    "reached": is_success(*means),
                }
            )
    return out


def search_row(paper: Path, control: Path) -> dict[str, Any]:
    """One search seed against the tests on its stages."""
    config, facts = read_config(paper)
    stages = stages_of(paper)
    others = stages_of(control) if (control / "summary.json").exists() else []
    costs = [stage["cost"] for stage in stages]
    reference = [float(stage["references/ep_return"][:, 0].mean()) for stage in stages]
    returns = [float(stage["ep_return"].mean()) for stage in stages]
    row = {
        "seed": config.seed,
        "stage_costs": [float(cost.mean()) for cost in costs],
        "stage_returns": returns,
        "reference_returns": reference,
        "control_stage_costs": [float(stage["cost"].mean()) for stage in others],
        **fall_of([paper]),
        "return_share": returns[-1] / reference[-1],
        "device": facts["device"],
        "versions": facts["versions"],
    }
    row["below_control"] = None  # the control has not been run
    if others:
        row["below_control"] = row["control_stage_costs"][-1] > row["stage_costs"][-1]
    row["keeps_return"] = row["return_share"] >= LAST_RETURN
    return row


def best_row(path: Path) -> dict[str, Any]:
    """The best cost of one search against the tests on its agents."""
    summary = json.loads((path / "summary.json").read_text())
    rows = summary["rows"]
    out: dict[str, Any] = {"rows": rows, "conclusion": summary["conclusion"]}
    for name in dict.fromkeys(row["algorithm"] for row in rows):
        best, plain = row_of(rows, name, "best"), row_of(rows, name, "extrinsic")
        safe = best["violation_rate"] / plain["violation_rate"]
        kept = best["return"] / plain["return"]
        out[name] = {
            "violations_left": safe,
            "return_kept": kept,
            "reached": reaches_bars(rows, name),
        }
    return out


def table(result: dict[str, Any]) -> str:
    """The tables of experiments/results/main_job/main_job.md."""
    lines = [
        "| search seed | cost of each stage | fall (95 %) | control's last stage "
        "| return of each stage | share of the reference's | falls, below control, "
        "keeps return |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in result["searches"]:
        low, high = row["fall_95"]
        tests = (row["falls"], row["below_control"], row["keeps_return"])
        verdict = ", ".join(WORDS[passed] for passed in tests)
        control = "not run"
        if row["control_stage_costs"]:
            control = f"{row['control_stage_costs'][-1]:.2f}"
        lines.append(
            f"| {row['seed']} | {_series(row['stage_costs'], 2)} | {row['fall']:.2f} "
            f"({low:.2f} to {high:.2f}) | {control} | "
            f"{_series(row['stage_returns'], 1)} | {row['return_share']:.0%} | "
            f"{verdict} |"
        )
    low, high = result["together"]["fall_95"]
    lines.append(
        f"| all | | {result['together']['fall']:.2f} ({low:.2f} to {high:.2f}) | | | | "
        f"{WORDS[result['together']['falls']]} |"
    )
    lines += [
        "",
        "| search seed | algorithm | cost | return | violating episodes | extrinsic "
        "cost per episode | steps outside | seeds x episodes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seed, best in zip(result["seeds"], result["best"], strict=True):
        for row in best["rows"]:
            who = f"| {seed} | {row['algorithm']} | {row['cost']} | "
            lines.append(
                f"{who}{row['return']:.1f} | "
                f"{row['violation_rate']:.1%} | {row['ep_cost']:.3f} | "
                f"{row['outside_share']:.0%} | {row['seeds']} x {row['episodes']} |"
            )
    lines += [
        "",
        "| search seed | algorithm | violations left (at most 25 %) | return kept "
        "(at least 30 %) | reached |",
        "|---|---|---|---|---|",
    ]
    for seed, best in zip(result["seeds"], result["best"], strict=True):
        for name in ("ppo_lagrangian", "cpo"):
            row = best[name]
            lines.append(
                f"| {seed} | {name} | {row['violations_left']:.0%} | "
                f"{row['return_kept']:.0%} | {'yes' if row['reached'] else 'no'} |"
            )
    lines += [
        "",
        f"| {len(VALIDATION_SEEDS)} seeds that no search has seen: cost | algorithm "
        "| return, seed by seed | violating episodes | violations left | return kept "
        "| reached |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in result["validation"]:
        rates = ", ".join(f"{rate:.0%}" for rate in row["violation_rate"])
        lines.append(
            f"| {row['cost'].replace('paper_', 'best of search ')} | "
            f"{row['algorithm']} | {_series(row['return'], 1)} | "
            f"{rates} | {row['violations_left']:.0%} | {row['return_kept']:.0%} | "
            f"{'yes' if row['reached'] else 'no'} |"
        )
    return "\n".join(lines) + "\n"


def _series(values: list[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def figure(result: dict[str, Any], runs: Path, path: Path) -> None:
    """Candidates' costs by stage and seed; return against violations of the best."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seeds = result["seeds"]
    fig, axes = plt.subplots(1, 2 + len(seeds), figsize=(15, 3.4))
    for axis, seed in zip(axes, seeds, strict=False):
        for shift, selection in ((-0.1, "paper"), (0.1, "random")):
            path_of = search_dir(runs, selection, seed)
            if not (path_of / "summary.json").exists():
                continue
            stages = stages_of(path_of)
            color = "C0" if selection == "paper" else "0.6"
            for number, stage in enumerate(stages, 1):
                cost = stage["cost"]
                axis.plot([number + shift] * len(cost), cost, "o", ms=3, color=color)
            means = [stage["cost"].mean() for stage in stages]
            place = np.arange(1, len(stages) + 1) + shift
            label = f"{selection} selection"
            axis.plot(place, means, "-", color=color, label=label)
        axis.set(title=f"search seed {seed}", xlabel="stage", ylim=(0, None))
        axis.set_xticks(range(1, 1 + len(result["searches"][0]["stage_costs"])))
    axes[0].set_ylabel("extrinsic cost per episode")
    axes[0].legend(fontsize=7)
    marks = {"extrinsic": "s", "safety_margin_3x": "^", "best": "o"}
    for axis, name in zip(axes[len(seeds) :], ("ppo_lagrangian", "cpo"), strict=True):
        for seed, best in zip(result["seeds"], result["best"], strict=True):
            for cost, mark in marks.items():
                row = row_of(best["rows"], name, cost)
                label = cost if seed == result["seeds"][0] else None
                where = (100 * row["violation_rate"], row["return"])
                axis.plot(*where, mark, color=f"C{seed}", label=label)
        axis.set(title=name, xlabel="violating episodes, %", ylabel="return")
    axes[-1].legend(fontsize=7)
    fig.tight_layout()
    fig.savefig(path, dpi=80)


def require_same_job(paths: list[Path]) -> None:
    """Refuse runs of another preset that an earlier version left behind."""
    common = {"seed": 0, "selection": "paper", "num_finalists": 0}
    configs = [dataclasses.replace(read_config(path)[0], **common) for path in paths]
    for path, config in zip(paths, configs, strict=True):
        if config != configs[0]:
            raise SystemExit(f"{path} is not a run of the job of {paths[0]}")


def collect(options: Options) -> None:
    """JSON, table and figure of all runs."""
    runs, results, group = options.runs, options.results, group_of(options)
    papers = finished(options)
    seeds = [read_config(path)[0].seed for path in papers]
    controls = [search_dir(runs, "random", seed) for seed in seeds]
    require_same_job([path for path in (*papers, *controls) if path.exists()])
    own = " --only untuned" * (group == "untuned")
    result = {
        "command": " && ".join(
            f"python experiments/main_job.py {part}{own}"
            for part in ("run", "validate", "collect")
        ),
        "seeds": seeds,
        "config": read_document(papers[0])["config"],
        "searches": [search_row(*pair) for pair in zip(papers, controls, strict=True)],
        "together": fall_of(papers),
        "best": [best_row(path) for path in papers],
        "validation": validation_rows(papers, validation_dir(options)),
    }
    results.mkdir(parents=True, exist_ok=True)
    text = json.dumps(to_json(result), indent=1, allow_nan=False)
    file = results / ("untuned.json" if own else "main_job.json")
    file.write_text(text + "\n")
    file.with_suffix(".md").write_text(table(result))
    figure(result, runs, file.with_suffix(".png"))


PARTS = {"run": run, "validate": validate, "collect": collect}

if __name__ == "__main__":
    run_part("main_job", __doc__, PARTS, SEEDS)
