"""The dynamics of a scene: MJX's stages with this package's contacts and solver."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from autocost_jax.envs.physics.models import PhysicsModel, mujoco
from autocost_jax.envs.physics.solver import make_solver

Forward = Callable[[mjx.Model, mjx.Data], mjx.Data]


def make_forward(physics: PhysicsModel, rest: mjx.Data) -> Forward:
    """`mjx.forward` with MuJoCo's contact frames and this package's solver.

    But for the sensors, see `sense`.
    """
    solve = make_solver(physics.mj_model, rest) if physics.has_contacts else _unforced
    choices = physics.choices

    def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
        data = mjx.com_pos(model, mjx.kinematics(model, data))
        data = mjx.factor_m(model, mjx.crb(model, data))
        if physics.has_contacts:
            data = _align_frames(model, mjx.collision(model, data))
        data = _keep_deepest(choices, data) if choices.any() else data
        data = mjx.fwd_velocity(model, mjx.transmission(model, data))
        data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
        return solve(model, data)

    return forward


def _unforced(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """The solution where there is no constraint."""
    del model
    return data.replace(qacc=data.qacc_smooth)


def sense(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Data after `forward` with all sensors read."""
    data = mjx.sensor_vel(model, mjx.sensor_pos(model, data))
    return mjx.sensor_acc(model, data)


def _align_frames(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Contact frames of capsules on the floor along the capsule, as in MuJoCo.

    MJX turns them to a fixed direction where the capsule stands steeper than 60
    degrees; the friction pyramid then stands otherwise, which half of all steps of a
    Doggo feel.
    """
    impl: Any = data._impl
    contact = impl.contact
    kinds = jnp.asarray(model.geom_type)[contact.geom]
    plane, capsule = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_CAPSULE
    lies = (kinds[:, 0] == int(plane)) & (kinds[:, 1] == int(capsule))
    normal = contact.frame[:, 0]
    axis = data.geom_xmat[contact.geom[:, 1], :, 2]
    along = axis - normal * (normal * axis).sum(-1, keepdims=True)
    length = jnp.sqrt((along**2).sum(-1, keepdims=True))
    along = along / jnp.maximum(length, 1e-6)
    frame = jnp.stack([normal, along, jnp.cross(normal, along)], axis=1)
    lies &= length[:, 0] > 1e-6
    frame = jnp.where(lies[:, None, None], frame, contact.frame)
    aligned: Any = data.tree_replace({"_impl.contact.frame": frame})
    return aligned


def _keep_deepest(choices: np.ndarray, data: mjx.Data) -> mjx.Data:
    """Of the contacts of one geom with geoms of the same choice, the deepest.

    MuJoCo has one contact for a box at a pillar, on the lower or the upper edge of the
    box; here a ball of the pillar stands for each edge.
    """
    impl: Any = data._impl
    contact = impl.contact
    group = jnp.asarray(choices)[contact.geom]
    key = jnp.where(group > 0, -group, contact.geom)
    is_rival = (key[:, None] == key).all(-1) & (group > 0).any(-1)
    order = np.arange(len(contact.dist))
    deeper = contact.dist < contact.dist[:, None]
    deeper |= (contact.dist == contact.dist[:, None]) & (order < order[:, None])
    dist = jnp.where((is_rival & deeper).any(-1), 1.0, contact.dist)
    chosen: Any = data.tree_replace({"_impl.contact.dist": dist})
    return chosen


def fill_tendons(model: mjx.Model, data: mjx.Data) -> tuple[mjx.Model, mjx.Data]:
    """One row of zeros in the tendon arrays of a model that has no tendon.

    MJX multiplies them also when they are empty, and partitioning an empty `where`
    over two devices crashes the CPU compiler of jaxlib 0.11. `model.ntendon` stays 0,
    so the row is never filled and adds exact zeros.
    """
    zeros = jnp.zeros((1, 2), data.qpos.dtype)
    model = model.replace(
        tendon_lengthspring=zeros,
        tendon_stiffness=zeros[:, 0],
        tendon_damping=zeros[:, 0],
    )
    data = data.replace(ten_length=zeros[:, 0])
    row: Any = {
        "_impl.ten_J": jnp.zeros((1, model.nv), data.qpos.dtype),
        "_impl.ten_velocity": zeros[:, 0],
    }
    filled: Any = data.tree_replace(row)
    return model, filled
