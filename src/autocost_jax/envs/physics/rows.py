"""The rows of MuJoCo's constraint problem, for many small worlds at once.

A row says how fast an acceleration of each degree of freedom opens a contact's pyramid
edge or a joint limit, and how stiffly it is held. `mjx.make_constraint` makes the same
rows; this one exists because that one walks the tree of bodies for every contact.

As in `solver.py` worlds are lanes, the last axis. What a contact depends on is gathered
before, world by world: `inputs`.

Source: MuJoCo documentation, Computation, "Constraint model" and Modeling, "Solver
parameters"; engine_core_constraint.c.
Differs: pyramidal contacts of condim 6 and limits of sliding or hinge joints, nothing
else; all contacts are equally soft. Models that need more are refused.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from autocost_jax.envs.physics.models import mujoco

EDGES = 10  # of the pyramid of a contact: two for each of five friction directions


class Softness(NamedTuple):
    """How rows give way.

    Attributes:
      stiffness: [n or 1, 1] pull towards the limit, 1/s^2.
      damping: [n or 1, 1] 1/s.
      impedance: five arrays [n or 1, 1], MuJoCo's `solimp`.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    impedance: tuple[np.ndarray, ...]


class Rows(NamedTuple):
    """What does not change about a model's rows.

    Attributes:
      moves: [ngeom, nv] 1 where a degree of freedom moves a geom.
      weight: [ngeom] inverse translational weight of a geom's body.
      roots: [nv] body at whose subtree's centre of mass `cdof` is given.
      limited: [l] dof of each joint with a limit.
      limited_qpos: [l] its index in qpos.
      low: [l, 1] smallest allowed position, margin included.
      high: [l, 1] largest.
      limit_weight: [l, 1] inverse weight of the dof.
      contacts: softness of all contacts.
      limits: softness of the limits.
    """

    moves: np.ndarray
    weight: np.ndarray
    roots: np.ndarray
    limited: np.ndarray
    limited_qpos: np.ndarray
    low: np.ndarray
    high: np.ndarray
    limit_weight: np.ndarray
    contacts: Softness
    limits: Softness


class Inputs(NamedTuple):
    """What the rows are made of in W worlds with c contacts.

    Attributes:
      depth: [c, W] distance of the surfaces, negative inside.
      place: [c, 3, W] of the contact, from the first root's centre of mass.
      frame: [c, 3, 3, W] its axes, the normal first.
      friction: [c, 5, W] of sliding (two), turning and rolling (two).
      moves: [c, nv, W] 1 where a dof moves the second geom, -1 the first.
      weight: [c, W] inverse weight of both bodies.
      slide: [nv, 3, W] velocity that a dof gives to that centre of mass.
      turn: [nv, 3, W] angular velocity that it gives.
      qvel: [nv, W].
      limited: [l, W] positions of joints with limits.
    """

    depth: jax.Array
    place: jax.Array
    frame: jax.Array
    friction: jax.Array
    moves: jax.Array
    weight: jax.Array
    slide: jax.Array
    turn: jax.Array
    qvel: jax.Array
    limited: jax.Array


def make_rows(mj_model: Any, data: mjx.Data) -> Rows:
    """The rows of a `mujoco.MjModel` and any of its data.

    Raises:
      ValueError: the model needs rows of another kind.
    """
    impl: Any = data._impl
    joint, option = mujoco.mjtJoint, mujoco.mjtDisableBit
    with_limit = np.flatnonzero(mj_model.jnt_limited)
    softness = np.unique(
        np.concatenate(
            [
                np.column_stack([mj_model.geom_solref, mj_model.geom_solimp]),
                np.column_stack([mj_model.pair_solref, mj_model.pair_solimp]),
            ]
        ),
        axis=0,
    )
    is_pyramid = mj_model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    fits = {
        "pyramids of condim 6 alone": is_pyramid
        and bool((np.asarray(impl.contact.dim) == 6).all()),
        "equally soft contacts": len(softness) <= 1,
        "no margins of contacts": not any(
            x.any() for x in (mj_model.geom_margin, mj_model.pair_margin)
        ),
        "neither equalities nor tendons": mj_model.neq == mj_model.ntendon == 0,
        "no dry friction of joints": not mj_model.dof_frictionloss.any(),
        "limits of slides and hinges alone": bool(
            np.isin(
                mj_model.jnt_type[with_limit], (joint.mjJNT_SLIDE, joint.mjJNT_HINGE)
            ).all()
        ),
        "softness in seconds, not below two steps": not (
            mj_model.opt.disableflags & int(option.mjDSBL_REFSAFE)
        ),
    }
    for what, fit in fits.items():
        if not fit:
            raise ValueError(f"the constraint rows here need {what}")
    step = float(mj_model.opt.timestep)
    bodies = np.asarray(mj_model.geom_bodyid)
    margin = mj_model.jnt_margin[with_limit, None]
    dofs = mj_model.jnt_dofadr[with_limit]
    return Rows(
        moves=_ancestors(mj_model)[bodies],
        weight=mj_model.body_invweight0[bodies, 0],
        roots=mj_model.body_rootid[mj_model.dof_bodyid],
        limited=dofs,
        limited_qpos=mj_model.jnt_qposadr[with_limit],
        low=mj_model.jnt_range[with_limit, :1] + margin,
        high=mj_model.jnt_range[with_limit, 1:] - margin,
        limit_weight=mj_model.dof_invweight0[dofs, None],
        contacts=_softness(softness[:1, :2], softness[:1, 2:], step),
        limits=_softness(
            mj_model.jnt_solref[with_limit], mj_model.jnt_solimp[with_limit], step
        ),
    )


def _ancestors(mj_model: Any) -> np.ndarray:
    """[nbody, nv] 1 where a dof belongs to a body or to one that carries it."""
    result = np.zeros((mj_model.nbody, mj_model.nv))
    for body in range(1, mj_model.nbody):  # parents come first
        result[body] = result[mj_model.body_parentid[body]]
        result[body, mj_model.dof_bodyid == body] = 1
    return result


def _softness(solref: np.ndarray, solimp: np.ndarray, timestep: float) -> Softness:
    """MuJoCo's parameters [n, 2] and [n, 5] as spring, damper and impedance."""
    if (solref <= 0).any():
        raise ValueError("the constraint rows here need solref as times, not stiffness")
    low, high, width, middle, power = (x[:, None] for x in solimp.T)
    smallest, largest = mujoco.mjMINIMP, mujoco.mjMAXIMP
    low, high = np.clip(low, smallest, largest), np.clip(high, smallest, largest)
    middle = np.clip(middle, smallest, largest)
    time = np.maximum(solref[:, :1], 2 * timestep)
    ratio = solref[:, 1:]
    return Softness(
        stiffness=1 / (high * time * ratio) ** 2,
        damping=2 / (high * time),
        impedance=(low, high, np.maximum(width, 1e-15), middle, np.maximum(power, 1)),
    )


def inputs(rows: Rows, data: mjx.Data) -> Inputs:
    """What one world's rows are made of, without the lanes' axis.

    Args:
      rows: of its model.
      data: positions, velocities and contacts are known.
    """
    impl: Any = data._impl
    contact, dtype = impl.contact, data.qpos.dtype
    first, second = contact.geom[:, 0], contact.geom[:, 1]
    moves, weight = jnp.asarray(rows.moves, dtype), jnp.asarray(rows.weight, dtype)
    centre = data.subtree_com[rows.roots[0]]
    turn, slide = data.cdof[:, :3], data.cdof[:, 3:]
    slide += jnp.cross(turn, centre - data.subtree_com[rows.roots])
    return Inputs(
        depth=contact.dist,
        place=contact.pos - centre,
        frame=contact.frame,
        friction=contact.friction,
        moves=moves[second] - moves[first],
        weight=weight[second] + weight[first],
        slide=slide,
        turn=turn,
        qvel=data.qvel,
        limited=data.qpos[rows.limited_qpos],
    )


def build(
    rows: Rows, impratio: float, given: Inputs
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The rows of all lanes, limits first.

    Returns:
      J [nv, n, W], columns first; stiffness D [n, W]; reference r [n, W]. A row that is
      not violated is zero.
    """
    parts = [(_contact_rows(rows, impratio, given), rows.contacts)]
    if len(rows.limited):
        parts.insert(0, (_limit_rows(rows, given), rows.limits))
    built = []
    for (jacobian, stiffness, spring), softness in parts:
        terms = [a * b for a, b in zip(jacobian, given.qvel, strict=True)]
        speed = functools.reduce(jnp.add, terms)
        damping = softness.damping.astype(speed.dtype)
        built.append((jacobian, stiffness, -damping * speed - spring))
    jacobian, stiffness, reference = (
        jnp.concatenate(x, axis=-2) for x in zip(*built, strict=True)
    )
    return jacobian, stiffness, reference


def _contact_rows(rows: Rows, impratio: float, given: Inputs) -> tuple[jax.Array, ...]:
    """J [nv, 10 c, W], stiffness and spring [10 c, W] of the contacts' edges."""
    place = given.place[:, None]  # the same for all three axes
    moment = _cross(place, given.frame)
    push, twist = (jnp.moveaxis(x, 2, 0) for x in (given.frame, moment))
    is_in = jnp.where(given.depth < 0, jnp.swapaxes(given.moves, 0, 1), 0.0)

    def along(axis: int) -> jax.Array:  # [nv, c, W] opening along an axis
        terms = _products(push[:, :, axis], given.slide)
        terms += _products(twist[:, :, axis], given.turn)
        return is_in * functools.reduce(jnp.add, terms)

    def around(axis: int) -> jax.Array:
        terms = _products(push[:, :, axis], given.turn)
        return is_in * functools.reduce(jnp.add, terms)

    normal = along(0)
    others = [along(1), along(2), around(0), around(1), around(2)]
    sides = [given.friction[:, i] * other for i, other in enumerate(others)]
    edges = [edge for side in sides for edge in (normal + side, normal - side)]
    jacobian = jnp.stack(edges, axis=2)
    jacobian = jacobian.reshape(len(jacobian), -1, jacobian.shape[-1])
    square = given.friction[:, 0] ** 2
    weight = given.weight * (1 + square) * 2 * square / impratio
    held = _hold(weight, given.depth, rows.contacts)
    return jacobian, *(jnp.repeat(x, EDGES, axis=0) for x in held)


def _limit_rows(rows: Rows, given: Inputs) -> tuple[jax.Array, ...]:
    """J [nv, l, W], stiffness and spring [l, W] of the joints' limits."""
    above, below = given.limited - rows.low, rows.high - given.limited
    depth = jnp.minimum(above, below).astype(given.limited.dtype)
    sign = jnp.where(above < below, 1.0, -1.0).astype(depth.dtype)
    own = np.arange(len(given.qvel))[:, None, None] == rows.limited[:, None]
    jacobian = jnp.where(own & (depth < 0), sign, 0.0)
    return jacobian, *_hold(
        jnp.asarray(rows.limit_weight, depth.dtype), depth, rows.limits
    )


def _hold(
    weight: jax.Array, depth: jax.Array, softness: Softness
) -> tuple[jax.Array, jax.Array]:
    """Stiffness D and pull towards the surface, both [n, W], of rows at a depth."""
    dtype = depth.dtype
    low, high, width, middle, power = (x.astype(dtype) for x in softness.impedance)
    is_square = bool((power == 2).all())  # MuJoCo's default; a general power is slow

    def rise(x: jax.Array, knee: np.ndarray) -> jax.Array:
        return (x * x if is_square else x**power) / knee ** (power - 1)

    x = jnp.minimum(jnp.abs(depth) / width, 1.0)
    y = jnp.where(x < middle, rise(x, middle), 1 - rise(1 - x, 1 - middle))
    impedance = y * (high - low) + low
    stiffness = impedance / jnp.maximum(weight * (1 - impedance), 1e-15)
    pull = jnp.minimum(depth, 0.0) * impedance * softness.stiffness.astype(dtype)
    return stiffness, pull


def _products(axes: jax.Array, screws: jax.Array) -> list[jax.Array]:
    """Terms [nv, c, W] of the products of axes [3, c, W] with vectors [nv, 3, W]."""
    return [axes[i] * screws[:, i, None] for i in range(3)]


def _cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Cross product along the last axis but one."""

    def part(i: int, j: int) -> jax.Array:
        return a[..., i, :] * b[..., j, :] - a[..., j, :] * b[..., i, :]

    return jnp.stack([part(1, 2), part(2, 0), part(0, 1)], axis=-2)
