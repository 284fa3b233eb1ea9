"""The rows of the constraint problem against MJX's own."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from autocost_jax import env_config, make_env
from autocost_jax.envs.models import physics_model
from autocost_jax.envs.rows import build, inputs, make_rows

# Floor, box, pillars, joint limits, vases; capped and uncapped contacts.
WORLDS = {
    "Push-Hazard-Point": "reduced",
    "Goal-Pillar-Point": "full",
    "Push-Pillar-Car": "reduced",
    "Goal-Pillar-Doggo": "reduced",
    "PointGoal1": "reduced",
}
COUNT = 6


def moving_states(config):
    """qpos and qvel [COUNT, ...] after some random steps, some of them in contact."""
    env = make_env(config)

    def play(key):
        state = env.reset(key)

        def step(state, key):
            action = jax.random.uniform(key, (env.action_size,), minval=-1.0)
            return env.step(state, action), None

        state, _ = jax.lax.scan(step, state, jax.random.split(key, 30))
        return state.data.qpos, state.data.qvel

    return jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(3), COUNT))


@pytest.mark.parametrize(("name", "physics"), WORLDS.items())
def test_rows_are_those_of_mjx(name, physics):
    config = dataclasses.replace(env_config(name), physics=physics)
    mj_model = physics_model(config).mj_model
    model, rest = (
        mjx.put_model(mj_model, impl="jax"),
        mjx.make_data(mj_model, impl="jax"),
    )
    rows = make_rows(mj_model, rest)

    def both(qpos, qvel):
        data = rest.replace(qpos=qpos, qvel=qvel)
        if mj_model.nmocap:  # a pillar that leans on the robot
            near = qpos[:2] + jnp.array([0.25, 0.05])
            data = data.replace(mocap_pos=data.mocap_pos.at[0, :2].set(near))
        data = mjx.com_pos(model, mjx.kinematics(model, data))
        data = mjx.collision(model, mjx.crb(model, data))
        expect = mjx.make_constraint(model, data)._impl
        lanes = jax.tree.map(lambda x: x[..., None], inputs(rows, data))
        made = build(rows, float(mj_model.opt.impratio), lanes)
        jacobian, stiffness, reference = (x[..., 0] for x in made)
        theirs = (expect.efc_J, expect.efc_D, expect.efc_aref)
        return theirs, (jacobian.T, stiffness, reference)

    theirs, ours = jax.jit(jax.vmap(both))(*moving_states(config))
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
