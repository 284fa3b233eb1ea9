"""Training costs as data: a bank of cost terms and the intrinsic cost network.

    total = sum_k where(w_k != 0, w_k * term_k, 0)

A `TrainingCost` holds the weights, the network's parameters and the limit, so slots
with different costs differ in data only and share one program. A user adds a term by
passing a longer bank.
"""

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.config import LIDAR_BINS, THETA_SIZES
from autocost_jax.config.checks import FINITE, require
from autocost_jax.files import load_arrays
from autocost_jax.records import CostInputs, TrainingCost

HIDDEN = 4  # the paper's hidden layer: 8 * 4 + 4 + 4 + 1 = 41 parameters
_SIZES = " or ".join(str(size) for size in THETA_SIZES.values())


class CostTerm(NamedTuple):
    """A named term of a training cost.

    Attributes:
      name: how a method refers to it.
      fn: (CostInputs with fields [...], theta [D]) -> cost [...].
    """

    name: str
    fn: Callable[[CostInputs, jax.Array], jax.Array]


def intrinsic_cost(theta: jax.Array, lidar: jax.Array) -> jax.Array:
    """The evolved cost: sigmoid(W2 sigmoid(W1 lidar + b1) + b2), in (0, 1).

    Args:
      theta: [41] parameters: W1 [8, 4] row-major, b1 [4], W2 [4], b2; or [13]: a W1
        [1, 4] of the highest reading alone, see `intrinsic_logit`.
      lidar: [..., 8] the constraint lidar of the post-step state.

    Returns:
      [...] cost of the step.

    Source: He, Zhao & Liu 2023, section "Experiment Setting"; the sigmoid of the
    hidden layer and the parameter layout are ours.
    """
    return jax.nn.sigmoid(intrinsic_logit(theta, lidar))


def intrinsic_logit(theta: jax.Array, lidar: jax.Array) -> jax.Array:
    """What the output sigmoid of `intrinsic_cost` is taken of, [...].

    With a theta of 41 the paper's network. With one of 13 (ours) the same with the
    highest of the eight readings as its only input, which the distance D of the closest
    object decides: exp(-D). It can say what a safety margin says, and cannot be silent
    on one side of the robot.

    Raises:
      ValueError: another number of parameters, or of bins.
    """
    sizes = (theta.shape[-1], lidar.shape[-1])
    if sizes[0] not in THETA_SIZES.values() or sizes[1] != LIDAR_BINS:
        raise ValueError(
            f"the cost network has {_SIZES} parameters and reads {LIDAR_BINS} bins, "
            f"got {sizes[0]} parameters and {sizes[1]} bins"
        )
    split = theta.shape[-1] - 2 * HIDDEN - 1
    w1 = theta[:split].reshape(-1, HIDDEN)
    b1, w2, b2 = theta[split : split + HIDDEN], theta[split + HIDDEN : -1], theta[-1]
    if w1.shape[0] == 1:
        lidar = lidar.max(-1, keepdims=True)
    # Bins first: eight multiply-adds fuse where a [.., 8] x [8, 4] matmul would not.
    pre = b1 + sum(lidar[..., i, None] * w1[i] for i in range(w1.shape[0]))
    return jnp.sum(jax.nn.sigmoid(pre) * w2, axis=-1) + b2


def _extrinsic(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    del theta
    return inputs.cost


def _intrinsic(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    return intrinsic_cost(theta, inputs.constraint_lidar)


def _distance_decrease(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    del theta
    return jnp.maximum(inputs.previous_distance - inputs.distance, 0.0)


def _distance_change(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    del theta
    return inputs.previous_distance - inputs.distance


def _distance_change_indicator(inputs: CostInputs, theta: jax.Array) -> jax.Array:
    del theta
    closer = inputs.previous_distance - inputs.distance >= 0
    return closer.astype(inputs.distance.dtype)


def safety_margin(multiple: float) -> CostTerm:
    """The hand-made cost max(0, multiple * radius - distance), metres.

    Source: He, Zhao & Liu 2023, "The Necessity of AutoCost"; its exact form is not
    published, this one is ours.
    """

    def fn(inputs: CostInputs, theta: jax.Array) -> jax.Array:
        del theta
        return jnp.maximum(multiple * inputs.radius - inputs.distance, 0.0)

    return CostTerm(f"safety_margin_{multiple:g}x", fn)


BANK: tuple[CostTerm, ...] = (
    CostTerm("extrinsic", _extrinsic),
    CostTerm("intrinsic", _intrinsic),
    CostTerm("distance_decrease", _distance_decrease),
    CostTerm("distance_change", _distance_change),
    CostTerm("distance_change_indicator", _distance_change_indicator),
    safety_margin(1.0),
    safety_margin(2.0),
    safety_margin(3.0),
)
"""The cost terms of the package; a longer tuple adds a user's own."""


def total_cost(
    cost: TrainingCost, inputs: CostInputs, bank: Sequence[CostTerm] = BANK
) -> jax.Array:
    """The cost a learner sees; a term of weight 0 cannot poison it.

    Args:
      cost: weights [K] over `bank`, theta [D].
      inputs: fields [...].
      bank: the cost terms, static.

    Returns:
      [...] total cost of each step.
    """
    if cost.weights.shape[-1] != len(bank):
        raise ValueError(
            f"weights must have one entry for each of the {len(bank)} terms of the "
            f"bank, got {cost.weights.shape[-1]}"
        )
    total = jnp.zeros_like(inputs.cost)
    for weight, term in zip(cost.weights, bank, strict=True):
        total += jnp.where(weight != 0, weight * term.fn(inputs, cost.theta), 0.0)
    return total


def training_cost(
    method: str,
    theta: jax.Array | np.ndarray | None = None,
    limit: float = 0.0,
    bank: Sequence[CostTerm] = BANK,
) -> TrainingCost:
    """A `TrainingCost` from a method such as "extrinsic+0.1*safety_margin_2x".

    Args:
      method: terms of the bank joined by "+", each with an optional "weight*".
      theta: [D] parameters of the intrinsic network; required if the method uses it.
      limit: allowed cost per episode.
      bank: the cost terms that `method` may name.

    Raises:
      ValueError: unknown term (the message lists the bank), bad weight, theta of
        another shape, or no theta although the method uses the network.
    """
    weights, theta = parse_cost(method, theta, limit, bank)
    return TrainingCost(
        weights=jnp.asarray(weights),
        theta=jnp.asarray(theta, jnp.float32),
        limit=jnp.asarray(limit, jnp.float32),
    )


def parse_cost(
    method: str,
    theta: jax.Array | np.ndarray | None = None,
    limit: float = 0.0,
    bank: Sequence[CostTerm] = BANK,
) -> tuple[np.ndarray, jax.Array | np.ndarray]:
    """Weights [len(bank)] and theta [D] that a method names; JAX is not started.

    A configuration is read and checked with it before a run's processes meet.
    Arguments and errors are those of `training_cost`.
    """
    if not isinstance(limit, jax.Array):
        require(FINITE.holds(limit), "limit", FINITE.allowed, limit)
    names = [term.name for term in bank]
    weights = np.zeros(len(bank), np.float32)
    for part in method.split("+"):
        factor, _, name = part.strip().rpartition("*")
        if name.strip() not in names:
            raise ValueError(
                f"unknown cost term {name.strip()!r} in method {method!r}; "
                f"terms: {', '.join(names)}"
            )
        weight: Any = factor
        with contextlib.suppress(ValueError):
            weight = float(factor) if factor else 1.0
        what = f"weight {factor!r} in method {method!r}"
        require(FINITE.holds(weight), what, FINITE.allowed, weight)
        at = names.index(name.strip())
        total = float(weights[at]) + weight
        require(FINITE.holds(total), f"the sum of {what}", FINITE.allowed, total)
        weights[at] = total
    if theta is None:
        uses_network = "intrinsic" in names and weights[names.index("intrinsic")] != 0
        if uses_network:
            raise ValueError(
                f"method {method!r} needs the parameters of a cost (theta)"
            )
        theta = np.zeros(THETA_SIZES["lidar_mlp"], np.float32)
    if not _is_theta(np.shape(theta)):
        raise ValueError(f"theta must have {_SIZES} parameters, got {np.shape(theta)}")
    return weights, theta


def save_cost(
    path: str | Path, theta: jax.Array | np.ndarray, card: Mapping[str, Any]
) -> None:
    """Write `<path>.npz` (theta [D], float32) and `<path>.json` (its card).

    Raises:
      ValueError: if theta is not 41 or 13 finite numbers, the card not JSON, or the
        path a name of `list_costs`, by which `load_cost` would not find it again.
    """
    if str(path) in list_costs():
        raise ValueError(f"{path} is a cost of the package: write to ./{path} instead")
    file, theta = _npz(Path(path)), np.asarray(theta, np.float32)
    _check_theta(file, theta)
    text = json.dumps(dict(card), indent=2, allow_nan=False)
    np.savez(file, theta=theta)
    file.with_suffix(".json").write_text(text + "\n")


def list_costs() -> list[str]:
    """Names of the costs that the package brings along."""
    folder = resources.files("autocost_jax") / "pretrained"
    files = folder.iterdir() if folder.is_dir() else ()
    return sorted(file.name[:-4] for file in files if file.name.endswith(".npz"))


def load_cost(path: str | Path) -> jax.Array:
    """The parameters theta [D] of a saved cost, or of one the package brings along.

    Args:
      path: a name of `list_costs`, which goes before a file of that name, or a file.

    Raises:
      ValueError: if the file is missing or is not a cost: one line naming it.
    """
    file = _cost_file(path)
    if not file.exists():
        known = ", ".join(list_costs())
        raise ValueError(f"{file}: no such file, and no cost of the package ({known})")
    theta = np.asarray(load_arrays(file).get("theta", ()))
    _check_theta(file, theta)
    return jnp.asarray(theta, jnp.float32)


def cost_card(path: str | Path) -> dict[str, Any]:
    """The card of a saved cost: how it was found, its scores, where it fails.

    Args:
      path: as in `load_cost`.

    Raises:
      ValueError: if there is no readable card: one line naming it.
    """
    file = _cost_file(path).with_suffix(".json")
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{file} is not a readable card: {error}") from None


def _is_theta(shape: tuple[int, ...]) -> bool:
    return len(shape) == 1 and shape[0] in THETA_SIZES.values()


def _check_theta(file: Path, theta: np.ndarray) -> None:
    is_theta = _is_theta(theta.shape) and theta.dtype.kind in "fiu"
    if not is_theta or not np.isfinite(theta).all():
        raise ValueError(
            f"{file}: theta must be {_SIZES} finite numbers, "
            f"got {theta.dtype}{list(theta.shape)}"
        )


def _cost_file(path: str | Path) -> Path:
    """The file of a cost that the package brings along, or of a path."""
    if str(path) in list_costs():
        return _npz(
            Path(str(resources.files("autocost_jax") / "pretrained" / str(path)))
        )
    return _npz(Path(path))


def _npz(path: Path) -> Path:
    """`<path>.npz`, unless the path already says so; other dots belong to the name."""
    name = path.stem if path.suffix in (".npz", ".json") else path.name
    return path.with_name(f"{name}.npz")
