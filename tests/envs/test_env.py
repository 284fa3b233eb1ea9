import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_data import NUM_WORLDS

from autocost_jax.config import ENVS, SUITE, EnvConfig
from autocost_jax.envs.env import list_envs, make_env

FLOAT32 = 1e-5
REWARD_ROUNDING = 1e-6


def zeros_like_actions():
    return jnp.zeros((NUM_WORLDS, 2))


def numbers(state):
    """Every array of a state but its physics and key."""
    return [np.asarray(x) for x in jax.tree.leaves(state.replace(data=None, key=None))]


# --- the contract -------------------------------------------------------------------


def test_names():
    assert list_envs() == list(ENVS)
    with pytest.raises(ValueError, match="'Goal-Hazard-Plane'") as caught:
        make_env("Goal-Hazard-Plane")
    for name in (*ENVS, *SUITE):
        assert name in str(caught.value)


def test_static_facts(default_env):
    env = default_env.env
    assert (env.observation_size, env.action_size) == (28, 2)
    assert env.episode_length == 1000
    assert env.dt == pytest.approx(0.02)
    assert dict(env.obs_slices) == {
        "accelerometer": slice(0, 3),
        "goal_lidar": slice(3, 11),
        "gyro": slice(11, 14),
        "hazards_lidar": slice(14, 22),
        "magnetometer": slice(22, 25),
        "velocimeter": slice(25, 28),
    }
    assert env.config == EnvConfig()


@pytest.mark.parametrize("x64", [False, True])
def test_step_keeps_every_type(x64):
    """Shapes, dtypes and weak types; so a state is a legal scan carry."""
    with jax.enable_x64(x64):
        env = make_env(EnvConfig())
        dtype = jnp.float64 if x64 else jnp.float32
        key = jax.random.key(0)
        before = jax.eval_shape(env.reset, key)
        after = jax.eval_shape(env.step, before, jnp.zeros(2, dtype))
        layout = jax.eval_shape(env.reset_to, before.layout, key)
        for state in (after, layout):
            assert jax.tree.structure(state) == jax.tree.structure(before)
            for a, b in zip(
                jax.tree.leaves(before), jax.tree.leaves(state), strict=True
            ):
                assert (a.shape, a.dtype, a.weak_type) == (
                    b.shape,
                    b.dtype,
                    b.weak_type,
                )
        assert before.obs.dtype == before.data.qpos.dtype == dtype
        assert before.obs.shape == (28,)
        assert before.cost_inputs.constraint_lidar.shape == (8,)


def test_products_are_of_full_precision(default_env):
    """Where a GPU would round them by itself."""
    env = default_env.env
    state = jax.eval_shape(env.reset, jax.random.key(0))
    text = jax.jit(env.step).lower(state, jnp.zeros(2)).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line]
    assert products
    assert all("HIGHEST" in line for line in products)


def test_reset_is_fresh_and_consistent(default_env, worlds):
    state = worlds
    assert len(np.unique(np.asarray(state.layout.goal_xy), axis=0)) == NUM_WORLDS
    for part in numbers(state):
        assert np.isfinite(part).all()
    zero = (state.reward, state.cost, state.age, state.done, state.failed)
    assert not any(np.asarray(part).any() for part in zero)
    assert not any(np.asarray(part).any() for part in state.metrics.values())
    inputs = state.cost_inputs
    np.testing.assert_array_equal(inputs.distance, inputs.previous_distance)
    np.testing.assert_allclose(inputs.radius, 0.3)
    assert float(inputs.distance.min()) >= 0.8 - FLOAT32  # no cost at the start
    yaw = np.asarray(state.layout.robot_yaw)
    magnet = state.obs[:, default_env.env.obs_slices["magnetometer"]]
    expected = np.stack([-0.5 * np.sin(yaw), -0.5 * np.cos(yaw), 0 * yaw], -1)
    np.testing.assert_allclose(magnet, expected, atol=FLOAT32)


def test_same_key_same_episode(default_env, worlds):
    again = default_env.reset(jax.random.split(jax.random.key(0), NUM_WORLDS))
    one, two = worlds, again
    for step in range(3):
        action = jax.random.normal(jax.random.key(step), (NUM_WORLDS, 2))
        one, two = default_env.step(one, action), default_env.step(two, action)
    for a, b in zip(numbers(one), numbers(two), strict=True):
        np.testing.assert_array_equal(a, b)
    other = default_env.reset(jax.random.split(jax.random.key(1), NUM_WORLDS))
    assert np.abs(other.layout.hazards - worlds.layout.hazards).max() > 0.1


def test_actions_are_clipped(default_env, worlds):
    far = default_env.step(worlds, jnp.full((NUM_WORLDS, 2), 1e6))
    near = default_env.step(worlds, jnp.ones((NUM_WORLDS, 2)))
    np.testing.assert_array_equal(far.data.qvel, near.data.qvel)
    np.testing.assert_array_equal(far.data.ctrl, 1.0)


def test_done_at_the_time_limit_only(default_env, worlds):
    ages = jnp.where(jnp.arange(NUM_WORLDS) < 100, 998, 999).astype(jnp.int32)
    state = default_env.step(worlds.replace(age=ages), zeros_like_actions())
    np.testing.assert_array_equal(state.done, ages == 999)
    late = default_env.step(state, zeros_like_actions())  # goes on, without a reset
    np.testing.assert_array_equal(late.done, ages == 998)
    np.testing.assert_array_equal(late.age, ages + 2)


def test_distances_and_path_length(default_env, worlds):
    state, before = worlds, np.zeros(NUM_WORLDS)
    for _ in range(3):
        previous = state
        state = default_env.step(state, jnp.ones((NUM_WORLDS, 2)))
        moved = np.linalg.norm((state.data.qpos - previous.data.qpos)[:, :2], axis=-1)
        before += moved
        np.testing.assert_array_equal(
            state.cost_inputs.previous_distance, previous.cost_inputs.distance
        )
    np.testing.assert_allclose(
        state.metrics["distance_travelled"], before, atol=FLOAT32
    )
    np.testing.assert_allclose(state.layout.robot_xy, state.data.qpos[:, :2])
    offset = state.layout.hazards - state.layout.robot_xy[:, None]
    closest = np.linalg.norm(offset, axis=-1).min(-1)
    np.testing.assert_allclose(state.cost_inputs.distance, closest, atol=FLOAT32)


def test_dense_cost_inside_a_hazard(default_env, worlds):
    """Put the robot 0.1 m from a hazard: the cost is 0.3 - 0.1, from its origin."""
    xy = worlds.layout.hazards[:, 0] + jnp.array([0.1, 0.0])
    qpos = jnp.concatenate([xy, jnp.zeros((NUM_WORLDS, 1))], -1)
    state = worlds.replace(data=worlds.data.replace(qpos=qpos))
    after = default_env.step(state, zeros_like_actions())
    np.testing.assert_allclose(after.cost, 0.2, atol=FLOAT32)
    np.testing.assert_array_equal(after.cost_inputs.cost, after.cost)


def test_default_cost_lidar_is_the_observed_one(default_env, worlds):
    seen = worlds.obs[:, default_env.env.obs_slices["hazards_lidar"]]
    np.testing.assert_array_equal(seen, worlds.cost_inputs.constraint_lidar)


# --- goals --------------------------------------------------------------------------


def on_goal(worlds):
    """Every robot standing on its goal, with the next reward starting there."""
    yaw = jnp.zeros((NUM_WORLDS, 1))
    qpos = jnp.concatenate([worlds.layout.goal_xy, yaw], -1)
    distances = jnp.zeros_like(worlds.task_distances)
    data = worlds.data.replace(qpos=qpos)
    return worlds.replace(data=data, task_distances=distances)


def test_met_goal_moves_and_nothing_else(default_env, worlds):
    state = on_goal(worlds)
    after = default_env.step(state, zeros_like_actions())
    np.testing.assert_allclose(after.reward, 1.0, atol=REWARD_ROUNDING)
    assert (after.metrics["goals_met"] == 1).all()
    moved = np.linalg.norm(after.layout.goal_xy - state.layout.goal_xy, axis=-1)
    failures = np.asarray(after.metrics["goal_move_failures"])
    assert failures.sum() <= 1  # below 4e-4 a move
    assert (moved[failures == 0] >= 0.8 - FLOAT32).all()
    np.testing.assert_array_equal(after.layout.hazards, state.layout.hazards)
    distance = np.linalg.norm(after.layout.goal_xy - after.layout.robot_xy, axis=-1)
    np.testing.assert_allclose(after.task_distances[:, 0], distance, atol=FLOAT32)
    # The observation shows the new goal.
    seen = after.obs[:, default_env.env.obs_slices["goal_lidar"]].max(-1)
    np.testing.assert_allclose(seen, np.exp(-distance), atol=FLOAT32)
    # The next reward starts from the new goal.
    later = default_env.step(after, zeros_like_actions())
    assert float(jnp.abs(later.reward).max()) < 0.01
    np.testing.assert_array_equal(later.layout.goal_xy, after.layout.goal_xy)


def test_goal_moves_differ_between_steps(default_env, worlds):
    state = on_goal(worlds)
    one = default_env.step(state, zeros_like_actions())
    two = default_env.step(state.replace(age=state.age + 1), zeros_like_actions())
    assert (
        jnp.abs(one.layout.goal_xy - two.layout.goal_xy).max(-1) > 1e-3
    ).mean() > 0.9


# --- failure ------------------------------------------------------------------------


def test_failed_world_goes_silent_and_stays_so(default_env, worlds):
    action = jnp.full((NUM_WORLDS, 2), 0.3)
    start = default_env.step(worlds, action)
    broken = start.replace(
        data=start.data.replace(qvel=start.data.qvel.at[3, 2].set(jnp.nan))
    )
    healthy, state = default_env.step(start, action), default_env.step(broken, action)
    assert np.flatnonzero(state.failed).tolist() == [3]
    for part in numbers(state):
        assert np.isfinite(part).all()
    others = np.arange(NUM_WORLDS) != 3
    for a, b in zip(numbers(state), numbers(healthy), strict=True):
        np.testing.assert_array_equal(a[others], b[others])
    # Sticky, even when the physics is repaired.
    later = default_env.step(state.replace(data=start.data), action)
    assert bool(later.failed[3])
    for part in (later.obs, later.reward, later.cost, later.cost_inputs.distance):
        assert not np.asarray(part[3]).any()
    assert not np.asarray(later.cost_inputs.constraint_lidar[3]).any()
    assert float(later.cost_inputs.radius[3]) == pytest.approx(0.3)
    travelled = later.metrics["distance_travelled"][3]
    assert float(travelled) == float(start.metrics["distance_travelled"][3])
    assert (
        int(later.age[3]) == 3
    )  # time runs on, so that the episode ends with the rest


@pytest.mark.slow
def test_impossible_layout_starts_failed(monkeypatch):
    monkeypatch.setattr("autocost_jax.envs.layout.MAX_HOST_FAILURES", 1.0)
    env = make_env(EnvConfig(hazards_num=30))
    state = jax.jit(env.reset)(jax.random.key(0))
    assert bool(state.failed)
    assert not np.asarray(state.obs).any()
