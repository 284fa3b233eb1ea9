"""The closed form of the Point: the same world as in MJX, number for number."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_data import NUM_WORLDS, Compiled, blank_layout, compile_env, states_at

from autocost_jax.config import EnvConfig, env_config
from autocost_jax.envs.env import make_env
from autocost_jax.envs.physics.closed_form import make_closed_form_world
from autocost_jax.envs.physics.world import make_world

CONFIG = EnvConfig(physics="closed_form")
# Rounding, after the yaw servo has multiplied it by -4 in each of ten substeps.
SUBSTEP, STEP = 1e-11, 1e-6


def random_states(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-3, 3, (num, 3)), rng.uniform(-2, 2, (num, 3))
    return qpos, qvel, rng.uniform(-1.5, 1.5, (num, 2))


def stepped(make, config: EnvConfig):
    """Physics and sensors after one control step from random states, in float64."""
    qpos, qvel, action = random_states(NUM_WORLDS)
    with jax.enable_x64(True):
        world, layout = make(config), blank_layout(config)

        @jax.jit
        @jax.vmap
        def step(qpos, qvel, action):
            start = world.place(layout).replace(qpos=qpos, qvel=qvel)
            data = world.control_step(start, layout, action)
            return data, world.sensors(data)

        return jax.device_get(step(qpos, qvel, action))


@functools.cache
def compiled() -> Compiled:
    return compile_env(CONFIG)


@pytest.mark.parametrize(
    ("substeps", "bound"),
    [(1, SUBSTEP), pytest.param(10, STEP, marks=pytest.mark.slow)],
)
def test_equals_mjx_to_rounding(substeps, bound):
    """Every field of the physics, and every sensor."""
    config = dataclasses.replace(CONFIG, frameskip_binom_n=substeps)
    got = stepped(make_closed_form_world, config)
    expected = stepped(make_world, dataclasses.replace(config, physics="reduced"))
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for ours, mjx in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert ours.shape == mjx.shape
        assert ours.dtype == mjx.dtype
        scale = 100.0  # the accelerometer is of the order of accelerations
        np.testing.assert_allclose(ours, mjx, atol=bound * scale, rtol=bound)


def test_is_the_same_environment(default_env, worlds):
    """A step of every field of the state, in float32; also where goals are met."""
    env = compiled()
    reset = env.reset(jax.random.split(jax.random.key(0), NUM_WORLDS))
    goals = worlds.layout.goal_xy
    action = np.tile([1.0, 1.0], (NUM_WORLDS, 1))  # the servo saturates: no chatter

    def step(compiled, state):
        qpos = state.data.qpos.at[::2, :2].set(goals[::2])
        data = state.data.replace(qpos=qpos)
        return compiled.step(state.replace(data=data), action)

    for got, expected in [
        (reset, worlds),
        (step(env, reset), step(default_env, worlds)),
    ]:
        got, expected = got.replace(key=None), expected.replace(key=None)
        pairs = zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True)
        for ours, mjx in pairs:
            np.testing.assert_allclose(ours, mjx, atol=2e-3, rtol=1e-3)
    assert got.metrics["goals_met"][::2].all()


def test_steps_match_the_record(free_point):
    """The same bars as MJX: positions, and yaw rates up to the servo's chatter."""
    env = compiled()
    layout = blank_layout(CONFIG)
    qpos, qvel = free_point["qpos"], free_point["qvel"]
    after = env.step(
        states_at(env.env, layout, qpos[:-1], qvel[:-1]), free_point["actions"]
    )
    np.testing.assert_allclose(after.data.qpos, qpos[1:], atol=1e-4)
    error = np.abs(after.data.qvel - qvel[1:])
    assert error.max() < 0.1
    assert (error[:, 2] < 1e-3).mean() >= 0.99


def test_turns_as_fast_as_the_fact_sheet_says():
    """Mean yaw rate of the chattering servo, for some constant actions."""
    expected = {0.05: 0.0, 0.2: 0.495, 0.5: 1.350, 0.8: 2.438, 1.0: 2.998}
    env = compiled()
    num_steps, skipped = 200, 50
    turns = np.resize(list(expected), NUM_WORLDS)
    action = jnp.asarray(np.stack([np.zeros(NUM_WORLDS), turns], 1))
    state = env.reset(jax.random.split(jax.random.key(0), NUM_WORLDS))
    headings = []
    for _ in range(num_steps):
        state = env.step(state, action)
        headings.append(np.asarray(state.data.qpos[:, 2], np.float64))
    rate = (headings[-1] - headings[skipped - 1]) / (num_steps - skipped) / env.env.dt
    for turn, value in expected.items():
        assert rate[turns == turn].mean() == pytest.approx(value, abs=0.03), turn


@pytest.mark.parametrize(
    "name", ["Goal-Pillar-Point", "Push-Hazard-Point", "Goal-Hazard-Car", "PointGoal1"]
)
def test_refuses_what_can_touch(name):
    with pytest.raises(ValueError, match="physics"):
        dataclasses.replace(env_config(name), physics="closed_form")


def test_goal_1_without_its_vase_is_allowed():
    config = dataclasses.replace(
        env_config("PointGoal1"), vases_num=0, physics="closed_form"
    )
    assert make_env(config).observation_size == 12 + 3 * config.lidar_num_bins
