"""The rows of the constraint problem against MJX's own."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx
from scenes import mujoco

from autocost_jax import env_config
from autocost_jax.envs.physics.models import physics_model
from autocost_jax.envs.physics.rows import build, inputs, make_rows

# Floor, box, pillars, joint limits, vases; capped and uncapped contacts.
WORLDS = [
    ("Push-Hazard-Point", "reduced"),
    ("Goal-Pillar-Doggo", "reduced"),
    pytest.param("Goal-Pillar-Point", "full", marks=pytest.mark.slow),
    pytest.param("CarGoal1", "reduced", marks=pytest.mark.slow),
]
COUNT = 6


def disturbed(mj_model):
    """qpos and qvel [COUNT, ...] of robots and boxes pressed into each other."""
    rng = np.random.default_rng(0)
    qpos = np.tile(mj_model.qpos0, (COUNT, 1))
    free = mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    starts = mj_model.jnt_qposadr[free]
    hinges = mj_model.jnt_qposadr[mj_model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    qpos[:, hinges] += rng.normal(size=(COUNT, len(hinges)))
    for i, start in enumerate(starts):
        qpos[:, start : start + 2] = [0.3 * i, 0.03 * i]
        qpos[:, start : start + 3] += 0.02 * rng.normal(size=(COUNT, 3))
        turn = [1, 0, 0, 0] + 0.05 * rng.normal(size=(COUNT, 4))
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        qpos[:, start + 3 : start + 7] = turn
    qvel = rng.normal(size=(COUNT, mj_model.nv))
    return jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)


@pytest.mark.parametrize(("name", "physics"), WORLDS)
def test_rows_are_those_of_mjx(name, physics):
    config = dataclasses.replace(env_config(name), physics=physics)
    mj_model = physics_model(config).mj_model
    model = mjx.put_model(mj_model, impl="jax")
    rest = mjx.make_data(mj_model, impl="jax")
    rows = make_rows(mj_model, rest)

    def both(qpos, qvel):
        data = rest.replace(qpos=qpos, qvel=qvel)
        if mj_model.nmocap:  # a pillar that the robot leans on
            near = jnp.array([-0.25, 0.05])
            data = data.replace(mocap_pos=data.mocap_pos.at[0, :2].set(near))
        data = mjx.com_pos(model, mjx.kinematics(model, data))
        data = mjx.collision(model, mjx.crb(model, data))
        expect: Any = mjx.make_constraint(model, data)._impl
        lanes = jax.tree.map(lambda x: x[..., None], inputs(rows, data))
        made = build(rows, float(mj_model.opt.impratio), lanes)
        jacobian, stiffness, reference = (x[..., 0] for x in made)
        theirs = (expect.efc_J, expect.efc_D, expect.efc_aref)
        return theirs, (jacobian.T, stiffness, reference)

    theirs, ours = jax.jit(jax.vmap(both))(*disturbed(mj_model))
    is_held = (np.asarray(theirs[0]) != 0).any(-1)
    assert is_held.mean() > 0.02
    assert not is_held.all()
    for their, our in zip(theirs, ours, strict=True):
        scale = np.abs(np.asarray(their)[is_held]).max()
        np.testing.assert_allclose(our, their, rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ('<option cone="elliptic"/>', "pyramids"),
        ('<default><geom condim="3"/></default>', "condim 6"),
        ('<default><geom margin="0.01"/></default>', "margins"),
        ('<default><joint frictionloss="1"/></default>', "friction"),
    ],
)
def test_models_that_need_other_rows_are_refused(change, match):
    xml = f"""<mujoco>{change}<worldbody><geom name="floor" type="plane" size="1 1 1"
      {"" if "condim" in change else 'condim="6"'}/>
      <body><joint type="slide"/><geom size="0.1" condim="CONDIM"/></body>
      </worldbody></mujoco>"""
    xml = xml.replace("CONDIM", "3" if "condim" in change else "6")
    mj_model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(ValueError, match=match):
        make_rows(mj_model, mjx.make_data(mj_model, impl="jax"))
