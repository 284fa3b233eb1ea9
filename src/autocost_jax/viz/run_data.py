"""From a run directory to its report."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from autocost_jax.config import SearchConfig
from autocost_jax.costs import load_cost
from autocost_jax.es import Fitness, pool, rank
from autocost_jax.files import RunDirError, load_arrays
from autocost_jax.population import run_compiled
from autocost_jax.runs.artifacts import read_object, read_recording, stage_files
from autocost_jax.runs.directory import read_config, read_metrics
from autocost_jax.runs.labels import COST_LABELS, algorithm_label
from autocost_jax.search.evolution import pick_label
from autocost_jax.search.stages import REFERENCES, deal
from autocost_jax.viz.cost_map import network_cost
from autocost_jax.viz.replay import Replay
from autocost_jax.viz.report import (
    BestCandidate,
    Curve,
    ReferenceScore,
    ReportData,
    StageRecord,
    SummaryRow,
    write_report,
)
from autocost_jax.viz.scene import make_replay


def load_report(path: str | Path) -> ReportData:
    """Everything the report of a run shows; works on unfinished runs, too.

    Raises:
      RunDirError: the directory is not a run, or one of its files is broken.
    """
    path = Path(path)
    config, facts = read_config(path, SearchConfig)
    rows = _rows(config, path)
    read = [_stage(config, *each) for each in enumerate(stage_files(path))]
    stages = tuple(stage for stage, _ in read)
    card = read_object(path / "cost.json")
    best = _best(config, stages, card)
    summary = {} if best is None else read_object(path / "summary.json")
    obstacle = config.train.env.constrained[0]
    return ReportData(
        title=f"AutoCost on {config.train.env.name}",
        config=_config_lines(config, facts, rows),
        algorithms=config.algorithms,
        deterministic=False,
        obstacle=obstacle[:-1],
        obstacle_radius=getattr(config.train.env, f"{obstacle}_size"),
        stages=stages,
        best=best,
        curves=tuple(_curves(config, rows)),
        replays=() if best is None else _replays(path, config),
        summary=_summary(path, summary),
        conclusion=summary.get("conclusion", ""),
        references=tuple(score for _, scores in read for score in scores),
        can_violate=_can_violate(config, rows),
    )


def write_run_report(path: Path, out: Path | None = None) -> Path:
    """Write the report of a run, by default into it; returns its place.

    Raises:
      RunDirError: as `load_report`.
    """
    return write_report(load_report(path), out or path / "report" / "index.html")


def _references(
    config: SearchConfig, number: int, arrays: dict[str, np.ndarray]
) -> list[ReferenceScore]:
    """What the reference costs of a stage came to."""
    if not config.references:
        return []
    length = config.train.env.num_steps
    return [
        ReferenceScore(
            stage=number,
            algorithm=name,
            cost=cost,
            ep_return=float(arrays["references/ep_return"][a, r]),
            ep_cost=float(arrays["references/ep_cost"][a, r]),
            violation_rate=float(arrays["references/violating_worlds"][a, r]),
            outside_share=float(arrays["references/steps_outside"][a, r]) / length,
        )
        for a, name in enumerate(config.algorithms)
        for r, cost in enumerate(REFERENCES)
    ]


def _can_violate(config: SearchConfig, rows: list[dict[str, Any]]) -> bool:
    """Whether any agent of the run has ever violated; True while there are no rows.

    Where none has, not even in its first epochs, episodes are too short for it.
    """
    names = [f"{name}/violating_worlds" for name in config.algorithms]
    return not rows or any(np.max(row[name]) > 0 for row in rows for name in names)


def _rows(config: SearchConfig, path: Path) -> list[dict[str, Any]]:
    """The run's metrics; each row has what the report draws of every slot."""
    rows, slots = read_metrics(path), config.slots_per_algorithm
    keys = ("ep_return", "ep_cost", "ep_total_cost", "violating_worlds")
    names = [f"{name}/{key}" for name in config.algorithms for key in keys]
    for number, row in enumerate(rows, start=1):
        stage, epoch = row.get("stage"), row.get("epoch")
        odd = [name for name in names if not _is_column(row.get(name), slots)]
        is_known = stage in range(config.total_stages) and isinstance(epoch, int)
        if odd or not is_known:
            what = odd[0] if odd else f"stage {stage!r}, epoch {epoch!r}"
            raise RunDirError(f"{path}: row {number} of its metrics has a bad {what}")
    return rows


def _is_column(value: Any, slots: int) -> bool:
    """Whether a value is a number for each slot."""
    try:
        return np.asarray(value, float).shape == (slots,)
    except (TypeError, ValueError):
        return False


def _summary(path: Path, summary: dict[str, Any]) -> tuple[SummaryRow, ...]:
    """The rows of summary.json; its "return" is what Python calls `ep_return`."""
    names = {field.name: field.name for field in dataclasses.fields(SummaryRow)}
    names |= {"ep_return": "return"}
    try:
        return tuple(
            SummaryRow(**{name: row[key] for name, key in names.items()})
            for row in summary.get("rows", ())
        )
    except (KeyError, TypeError) as error:
        raise RunDirError(f"{path / 'summary.json'} has a bad row: {error}") from None


def _stage(
    config: SearchConfig, number: int, file: Path
) -> tuple[StageRecord, list[ReferenceScore]]:
    arrays = load_arrays(file)
    try:
        return _stage_record(config, arrays), _references(config, number, arrays)
    except (KeyError, IndexError) as error:
        raise RunDirError(f"{file} is not the file of a stage: {error}") from None


def _stage_record(config: SearchConfig, arrays: dict[str, np.ndarray]) -> StageRecord:
    parents = [np.flatnonzero((arrays["theta"] == e).all(1)) for e in arrays["elites"]]
    return StageRecord(
        theta=arrays["theta"],
        cost=arrays["cost"],
        judged=arrays["judged"],
        ep_return=arrays["ep_return"],
        algorithm_cost=arrays["scores/ep_cost"],
        algorithm_return=arrays["scores/ep_return"],
        zero_violation=arrays["cost"] <= config.zero_tolerance,
        violation_rate=arrays["scores/violating_worlds"],
        outside_share=arrays["scores/steps_outside"] / config.train.env.num_steps,
        elites=np.asarray([match[0] for match in parents]),
        far_cost=_known_mean(arrays["scores/intrinsic_far"]),
        near_cost=_known_mean(arrays["scores/intrinsic_near"]),
    )


def _known_mean(values: np.ndarray) -> np.ndarray:
    """Mean over algorithms [A, P] -> [P] without NaN; NaN where all are."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.nan)


def _best(
    config: SearchConfig, stages: tuple[StageRecord, ...], card: dict[str, Any]
) -> BestCandidate | None:
    """The card's pick; before there is one, the best of the finished stages.

    None if there is no stage yet, or one without a finite candidate.
    """
    if not stages or not all(stage.finite.any() for stage in stages):
        return None

    def joined(name: str) -> Any:
        return np.concatenate([getattr(stage, name) for stage in stages])

    fitness = Fitness(joined("judged"), joined("ep_return"))
    if config.pool_scores:
        fitness = run_compiled(pool, joined("theta"), fitness)
    tolerance = config.zero_tolerance
    first = int(run_compiled(rank, fitness, zero_tolerance=tolerance)[0])
    number, index = divmod(first, config.population_size)
    number, index = card.get("stage", number), card.get("index", index)
    if number not in range(len(stages)) or index not in range(config.population_size):
        raise RunDirError(f"cost.json is of stage {number!r}, index {index!r}: no such")
    stage = stages[number]
    is_zero = bool(stage.zero_violation[index])
    shown = ("environment", "judged_by", "search_score", "search_return")
    shown += ("env_steps", "seed")
    return BestCandidate(
        stage=number,
        index=index,
        theta=stage.theta[index],
        label=card.get("label", pick_label(config, is_zero)),
        card=tuple(f"{key}: {card[key]}" for key in shown if key in card),
    )


def _curves(config: SearchConfig, rows: list[dict[str, Any]]) -> list[Curve]:
    """Curves of the candidates, and of the finalists as one stage more."""
    curves = []
    for number in sorted({row["stage"] for row in rows}):
        chosen = [row for row in rows if row["stage"] == number]
        dealt = deal(config, is_final=number == config.num_stages)
        count = dealt.num_costs - config.num_references
        for name in config.algorithms:

            def column(key: str, name=name, chosen=chosen, dealt=dealt, count=count):
                values = np.asarray([row[f"{name}/{key}"] for row in chosen], float)
                return dealt.table(values)[:, :count].mean(-1)

            curves.append(
                Curve(
                    stage=number,
                    algorithm=name,
                    epoch=np.asarray([row["epoch"] for row in chosen]),
                    ep_return=column("ep_return"),
                    ep_cost=column("ep_cost"),
                    ep_total_cost=column("ep_total_cost"),
                )
            )
    return curves


def _replays(path: Path, config: SearchConfig) -> tuple[Replay, ...]:
    """The recordings that the run has left, those of the best cost first."""
    if not (path / "cost.npz").exists():
        return ()
    theta = np.asarray(load_cost(path / "cost.npz"))
    replays = []
    for kind in ("best", *REFERENCES):
        for name in config.algorithms:
            file = path / f"replay_{kind}_{name}.npz"
            if not file.exists():
                continue
            recording = read_recording(file)
            intrinsic = None
            if kind == "best":
                intrinsic = network_cost(theta, recording.constraint_lidar)
            replay = make_replay(
                config.train.env,
                recording,
                intrinsic=intrinsic,
                label=f"{algorithm_label(name)}, {COST_LABELS[kind]}",
            )
            replays.append(replay)
    return tuple(replays)


def _config_lines(
    config: SearchConfig, facts: dict[str, Any], rows: list[dict[str, Any]]
) -> dict[str, str]:
    train, agent = config.train, config.train.agent
    versions = facts.get("versions", {})
    lines = {
        "environment": train.env.name,
        "algorithms": ", ".join(config.algorithms),
        "cost limit": f"{config.cost_limit:g}",
        "population": f"{config.population_size}, {config.num_elites} elites",
        "stages": str(config.num_stages),
        "selection": config.selection,
        "initial std of theta": f"{config.init_std:g}",
        "epochs a stage": f"{train.num_epochs}, the last {config.fitness_epochs} count",
        "an epoch": f"{train.num_worlds} worlds x {train.env.num_steps} steps a slot",
        "networks": "-".join(str(size) for size in agent.hidden_sizes),
        "policy steps": f"{agent.policy_passes} passes x {agent.policy_minibatches}",
        "critic steps": f"{agent.value_passes} passes x {agent.value_minibatches}",
        "seed": str(config.seed),
        "env steps": f"{config.env_steps:,}",
        "device": f"{facts.get('num_devices', '?')} x {facts.get('device', '?')}",
    }
    rates = [row.get("time/env_steps_per_second") for row in rows]
    if rates and rates[-1]:
        lines["steps/s"] = f"{rates[-1]:,.0f}"
    lines["versions"] = ", ".join(f"{name} {text}" for name, text in versions.items())
    lines["commit"] = str(facts.get("commit"))
    return lines
