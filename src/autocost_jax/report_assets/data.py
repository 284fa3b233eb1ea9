"""What a report is made of: plain records, checked when they are made."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from autocost_jax.report_assets.cost_field import THETA_SIZES, Array
from autocost_jax.report_assets.replay import Replay

TIMID_DISTANCE = 1.0  # metres an episode; an agent below it hardly moves


@dataclass(frozen=True, eq=False)
class StageRecord:
    """One finished stage of the search.

    Attributes:
      theta: [P, D] the candidates' networks.
      cost: [P] extrinsic cost of an episode, by `judge_by`; +inf: frozen.
      ep_return: [P] return of an episode, likewise; -inf: frozen.
      algorithm_cost: [A, P] the same cost of each algorithm's agent.
      algorithm_return: [A, P] the same return of each algorithm's agent.
      zero_violation: [P] bool, whether no fitness episode had any extrinsic cost.
      elites: [K] indices of the candidates that were selected, best first.
      far_cost: [P] mean intrinsic cost over visited states far from obstacles, or None.
      near_cost: [P] the same close to hazards, or None. NaN: no such state.
      distance_travelled: [A, P] metres an episode, or None.
    """

    theta: Array
    cost: Array
    ep_return: Array
    algorithm_cost: Array
    algorithm_return: Array
    zero_violation: Array
    elites: Array
    far_cost: Array | None = None
    near_cost: Array | None = None
    distance_travelled: Array | None = None

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
    def timid_share(self) -> float:
        """Share of agents travelling less than `TIMID_DISTANCE`; NaN if unknown."""
        if self.distance_travelled is None:
            return float("nan")
        known = np.isfinite(self.distance_travelled)
        return finite_mean(self.distance_travelled[known] < TIMID_DISTANCE)


@dataclass(frozen=True, eq=False)
class Curve:
    """How one algorithm learnt in one stage.

    Attributes:
      stage: index into `ReportData.stages`, from 0; may point at the stage that is
        still running.
      algorithm: one of `ReportData.algorithms`.
      epoch: [E] epoch numbers within the stage.
      ep_return: [E, P] return of an episode, by candidate.
      ep_cost: [E, P] extrinsic cost of an episode.
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
class Evaluation:
    """One row of the evaluation table.

    Attributes:
      label: policy and environment.
      return_mean: mean return of an episode.
      return_ci: half-width of its 95 % interval.
      cost_mean: mean extrinsic cost of an episode.
      cost_ci: half-width of its 95 % interval.
      violation_rate: share of episodes with any extrinsic cost.
      episodes: how many episodes were run.
    """

    label: str
    return_mean: float
    return_ci: float
    cost_mean: float
    cost_ci: float
    violation_rate: float
    episodes: int


@dataclass(frozen=True, eq=False)
class ReportData:
    """Everything a report shows.

    Attributes:
      title: name of the run.
      config: what to show about the run, in order; the tiles at the top use the
        keys "env steps", "duration", "steps/s" and "device" if they are there.
      algorithms: the A names, in the order of the [A, P] arrays.
      deterministic: whether the scored policies used the mean action.
      obstacle: what must be avoided, as a word in the singular: "hazard".
      obstacle_radius: its radius, for the heat map.
      stages: the finished stages; empty while the first is running.
      best: the result, or None if a stage has no finite candidate.
      curves: learning curves, any order.
      control_cost: [S] stage means of the extrinsic cost of a search whose
        selection is random, or None.
      control_return: [S] the same of the return, or None.
      replay: an episode of the best policy, or None.
      evaluations: rows of the evaluation table.

    Raises:
      ValueError: if shapes disagree, an index does not exist, or the best
        candidate's label contradicts its stage.
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
    control_cost: Array | None = None
    control_return: Array | None = None
    replay: Replay | None = None
    evaluations: tuple[Evaluation, ...] = field(default=())

    def __post_init__(self) -> None:
        for number, stage in enumerate(self.stages):
            _check_stage(stage, len(self.algorithms), f"stages[{number}]")
        for number, curve in enumerate(self.curves):
            _check_curve(curve, self.algorithms, f"curves[{number}]")
        if self.best is not None:
            _check_best(self.best, self.stages)


def _shape(value: Any, shape: tuple[int, ...], name: str) -> None:
    if value is not None and np.shape(value) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(value)}")


def _check_stage(stage: StageRecord, algorithms: int, name: str) -> None:
    size = np.shape(stage.cost)[0] if np.ndim(stage.cost) == 1 else -1
    if size < 1:
        raise ValueError(f"{name}.cost must be [P], got shape {np.shape(stage.cost)}")
    width = np.shape(stage.theta)[-1]
    if width not in THETA_SIZES:
        raise ValueError(f"{name}.theta must have {THETA_SIZES} columns, got {width}")
    _shape(stage.theta, (size, width), f"{name}.theta")
    for key in ("ep_return", "zero_violation", "far_cost", "near_cost"):
        _shape(getattr(stage, key), (size,), f"{name}.{key}")
    for key in ("algorithm_cost", "algorithm_return", "distance_travelled"):
        _shape(getattr(stage, key), (algorithms, size), f"{name}.{key}")
    if np.any((stage.elites < 0) | (stage.elites >= size)):
        raise ValueError(f"{name}.elites must be in [0, {size}), got {stage.elites}")


def _check_curve(curve: Curve, algorithms: tuple[str, ...], name: str) -> None:
    if curve.algorithm not in algorithms:
        raise ValueError(
            f"{name}.algorithm must be one of {', '.join(algorithms)}, "
            f"got {curve.algorithm!r}"
        )
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


def finite_mean(values: Array) -> float:
    """Mean of the finite values; NaN if there are none."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")
