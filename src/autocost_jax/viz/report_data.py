"""What a report is made of: plain records, checked when they are made."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from autocost_jax.config import THETA_SIZES
from autocost_jax.runs.labels import COST_LABELS
from autocost_jax.viz.cost_map import Array
from autocost_jax.viz.replay import Replay

NAN = float("nan")


@dataclass(frozen=True, eq=False)
class StageRecord:
    """One finished stage of the search.

    Attributes:
      theta: [P, D] the candidates' networks.
      cost: [P] extrinsic cost per episode, mean over the agents; +inf: frozen.
      judged: [P] what the candidates are ranked by, see `SearchConfig.judge_by`.
      ep_return: [P] return per episode, likewise; -inf: frozen.
      algorithm_cost: [A, P] the same cost of each algorithm's agent.
      algorithm_return: [A, P] the same return of each algorithm's agent.
      zero_violation: [P] bool, whether no fitness episode had any extrinsic cost.
      elites: [K] indices of the candidates that were selected, best first.
      far_cost: [P] mean intrinsic cost over visited states far from obstacles, or None.
      near_cost: [P] the same close to hazards, or None. NaN: no such state.
      violation_rate: [A, P] share of the training episodes at the end of the stage
        that had any extrinsic cost, or None.
      outside_share: [A, P] share of the steps that the agents spend outside the
        arena, or None.
    """

    theta: Array
    cost: Array
    judged: Array
    ep_return: Array
    algorithm_cost: Array
    algorithm_return: Array
    zero_violation: Array
    elites: Array
    far_cost: Array | None = None
    near_cost: Array | None = None
    violation_rate: Array | None = None
    outside_share: Array | None = None

    @property
    def finite(self) -> Array:
        """[P] bool, False where a candidate is frozen."""
        return np.isfinite(self.cost) & np.isfinite(self.ep_return)

    @property
    def mean_cost(self) -> float:
        """Mean extrinsic cost over the finite candidates; NaN without any."""
        return finite_mean(self.cost[self.finite])

    @property
    def mean_return(self) -> float:
        """Mean return over the finite candidates; NaN without any."""
        return finite_mean(self.ep_return[self.finite])

    @property
    def mean_violation_rate(self) -> float:
        """Mean share of violating episodes over the agents; NaN if unknown."""
        return finite_mean(
            np.nan if self.violation_rate is None else self.violation_rate
        )

    @property
    def mean_outside_share(self) -> float:
        """Mean share of the steps outside the arena; NaN if unknown."""
        return finite_mean(np.nan if self.outside_share is None else self.outside_share)


@dataclass(frozen=True, eq=False)
class Curve:
    """How one algorithm learnt in one stage.

    Attributes:
      stage: index into `ReportData.stages`, from 0; may point at the stage that is
        still running.
      algorithm: one of `ReportData.algorithms`.
      epoch: [E] epoch numbers within the stage.
      ep_return: [E, P] return per episode, by candidate.
      ep_cost: [E, P] extrinsic cost per episode.
      ep_total_cost: [E, P] extrinsic + intrinsic, what the learner sees.
    """

    stage: int
    algorithm: str
    epoch: Array
    ep_return: Array
    ep_cost: Array
    ep_total_cost: Array


@dataclass(frozen=True, eq=False)
class BestCandidate:
    """The search's result.

    Attributes:
      stage: index into `ReportData.stages`, from 0.
      index: its row in that stage.
      theta: [D] its network.
      label: why it is the best.
      card: lines that describe the saved cost.
    """

    stage: int
    index: int
    theta: Array
    label: str
    card: tuple[str, ...] = ()


@dataclass(frozen=True)
class SummaryRow:
    """How one algorithm's agents do under one cost, on fresh seeds and episodes.

    Attributes:
      algorithm: one of `ReportData.algorithms`.
      cost: a key of `COST_LABELS`: extrinsic, safety_margin_3x or best.
      ep_return: mean return per episode; NaN here and below: unknown.
      ep_cost: mean extrinsic cost per episode.
      violation_rate: share of the episodes with any extrinsic cost.
      outside_share: share of the steps outside the arena.
      seeds: how many agents were trained afresh; 0: unknown.
      episodes: how many episodes each of them was given; 0: unknown.
    """

    algorithm: str
    cost: str
    ep_return: float = NAN
    ep_cost: float = NAN
    violation_rate: float = NAN
    outside_share: float = NAN
    seeds: int = 0
    episodes: int = 0


@dataclass(frozen=True)
class ReferenceScore:
    """An agent trained beside a stage's candidates, with a cost that nobody evolved.

    Attributes:
      stage: index into `ReportData.stages`, from 0.
      algorithm: one of `ReportData.algorithms`.
      cost: extrinsic or safety_margin_3x.
      ep_return: its return per episode; NaN here and below: unknown.
      ep_cost: its extrinsic cost per episode.
      violation_rate: share of its episodes with any extrinsic cost.
      outside_share: share of its steps outside the arena.
    """

    stage: int
    algorithm: str
    cost: str
    ep_return: float = NAN
    ep_cost: float = NAN
    violation_rate: float = NAN
    outside_share: float = NAN


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything a report shows.

    Attributes:
      title: name of the run.
      config: what to show about the run, in order.
      algorithms: the A names, in the order of the [A, P] arrays.
      deterministic: whether the scored policies used the mean action.
      obstacle: what must be avoided, as a word in the singular: "hazard".
      obstacle_radius: its radius, for the heat map.
      stages: the finished stages; empty while the first is running.
      best: the result, or None if a stage has no finite candidate.
      curves: learning curves, any order.
      summary: how the best cost does beside the references, on fresh seeds; for each
        algorithm in the order of `COST_LABELS`.
      conclusion: whether the search succeeded and at which price, as a sentence; empty:
        the page makes one of the stages.
      references: agents trained beside the candidates.
      replays: recorded episodes; a label says algorithm and cost: "CPO, best cost".
      can_violate: False if episodes are too short for anyone to violate, so that no
        violations mean nothing.

    Raises:
      ValueError: if shapes disagree, or an index, algorithm or cost does not exist.
    """

    title: str
    config: Mapping[str, str]
    algorithms: tuple[str, ...]
    deterministic: bool
    obstacle: str
    obstacle_radius: float
    stages: tuple[StageRecord, ...] = ()
    best: BestCandidate | None = None
    curves: tuple[Curve, ...] = ()
    summary: tuple[SummaryRow, ...] = ()
    conclusion: str = ""
    references: tuple[ReferenceScore, ...] = ()
    replays: tuple[Replay, ...] = ()
    can_violate: bool = True

    def __post_init__(self) -> None:
        for number, stage in enumerate(self.stages):
            _check_stage(stage, len(self.algorithms), f"stages[{number}]")
        for number, curve in enumerate(self.curves):
            _check_curve(curve, self.algorithms, f"curves[{number}]")
        for name in ("summary", "references"):
            costs = tuple(COST_LABELS)[: 3 if name == "summary" else 2]
            for number, row in enumerate(getattr(self, name)):
                _check_name(
                    row.algorithm, self.algorithms, f"{name}[{number}].algorithm"
                )
                _check_name(row.cost, costs, f"{name}[{number}].cost")
        if self.best is not None:
            _check_best(self.best, self.stages)


def _check_name(value: str, known: tuple[str, ...], name: str) -> None:
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


def _shape(value: Any, shape: tuple[int, ...], name: str) -> None:
    if value is not None and np.shape(value) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")


def _check_stage(stage: StageRecord, algorithms: int, name: str) -> None:
    size = np.shape(stage.cost)[0] if np.ndim(stage.cost) == 1 else -1
    if size < 1:
        raise ValueError(f"{name}.cost must be [P], got shape {np.shape(stage.cost)}")
    width = np.shape(stage.theta)[-1]
    widths = sorted(THETA_SIZES.values())
    if width not in widths:
        raise ValueError(f"{name}.theta must have {widths} columns, got {width}")
    _shape(stage.theta, (size, width), f"{name}.theta")
    for key in ("ep_return", "zero_violation", "far_cost", "near_cost"):
        _shape(getattr(stage, key), (size,), f"{name}.{key}")
    by_algorithm = ("algorithm_cost", "algorithm_return", "violation_rate")
    for key in (*by_algorithm, "outside_share"):
        _shape(getattr(stage, key), (algorithms, size), f"{name}.{key}")
    if np.any((stage.elites < 0) | (stage.elites >= size)):
        raise ValueError(f"{name}.elites must be in [0, {size}), got {stage.elites}")


def _check_curve(curve: Curve, algorithms: tuple[str, ...], name: str) -> None:
    _check_name(curve.algorithm, algorithms, f"{name}.algorithm")
    shape = np.shape(curve.ep_return)
    if len(shape) != 2 or shape[0] != len(curve.epoch) or curve.stage < 0:
        raise ValueError(f"{name}.ep_return must be [E, P], got shape {shape}")
    _shape(curve.ep_cost, shape, f"{name}.ep_cost")
    _shape(curve.ep_total_cost, shape, f"{name}.ep_total_cost")


def _check_best(best: BestCandidate, stages: tuple[StageRecord, ...]) -> None:
    if not 0 <= best.stage < len(stages):
        raise ValueError(f"best.stage must be in [0, {len(stages)}), got {best.stage}")
    _shape(best.theta, np.shape(stages[best.stage].theta)[1:], "best.theta")
    zero = stages[best.stage].zero_violation
    if not 0 <= best.index < len(zero):
        raise ValueError(f"best.index must be in [0, {len(zero)}), got {best.index}")


def finite_mean(values: Any) -> float:
    """Mean of the finite values; NaN if there are none."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")
