"""Whole episodes of a fixed policy against a loop of single steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.evaluate import evaluate, run_episodes, score
from autocost_jax.runs.policies import eval_summary, score_line
from toys import ARENA, NUM_STEPS, LinearState, linear_agent, make_toy_env

NUM_EPISODES = 6
ROUNDING = 1e-5  # 16 float32 terms summed in another order


@pytest.fixture(scope="module")
def env():
    return make_toy_env()


@pytest.fixture(scope="module")
def state(env):
    """A policy that heads for the goal."""
    weights = jnp.zeros((env.observation_size, 2)).at[2:4].set(jnp.eye(2))
    return LinearState(weights, jnp.zeros((), jnp.int32))


def by_hand(env, state, key, deterministic):
    """Return, cost, path and share of steps outside of each episode, step by step."""
    agent = linear_agent(env)
    key_reset, key_act = jax.random.split(key)
    worlds = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_EPISODES))
    step = jax.jit(env.step)
    act = jax.jit(lambda obs, key: agent.policy(state, obs, key, deterministic))
    episodes = [jax.tree.map(lambda x, i=i: x[i], worlds) for i in range(NUM_EPISODES)]
    sums = np.zeros((4, NUM_EPISODES))
    for t in range(NUM_STEPS):
        obs = jnp.stack([world.obs for world in episodes])
        action = act(obs, jax.random.fold_in(key_act, t))
        for i in range(NUM_EPISODES):
            before = np.asarray(episodes[i].layout.robot_xy)
            episodes[i] = step(episodes[i], action[i])
            after = np.asarray(episodes[i].layout.robot_xy)
            path = np.linalg.norm(after - before)
            outside = (np.abs(after) > ARENA).any() / NUM_STEPS
            sums[:, i] += episodes[i].reward, episodes[i].cost, path, outside
    return sums


@pytest.mark.parametrize("deterministic", [False, True])
def test_sums_against_a_loop(env, state, key, deterministic):
    agent = linear_agent(env)
    result = jax.jit(
        lambda s, k: evaluate(env, agent, s, k, NUM_EPISODES, deterministic)
    )(state, key)
    ep_return, ep_cost, path, outside = by_hand(env, state, key, deterministic)
    np.testing.assert_allclose(result.ep_return, ep_return, atol=ROUNDING)
    np.testing.assert_allclose(result.ep_cost, ep_cost, atol=ROUNDING)
    np.testing.assert_allclose(result.distance_travelled, path, atol=ROUNDING)
    np.testing.assert_allclose(result.outside_share, outside, atol=ROUNDING)
    assert result.valid.tolist() == [1.0] * NUM_EPISODES
    assert len(np.unique(result.ep_return)) == NUM_EPISODES
    assert float(result.violation_rate) == pytest.approx((ep_cost > 0).mean())


def test_the_mean_acts_without_a_key(env, state, key):
    """Deterministic: the layouts alone decide. Sampled: the actions vary as well."""
    agent = linear_agent(env)
    starts, actions = {}, {}

    def watch(worlds):
        return worlds.layout.robot_xy, worlds.layout.goal_xy

    for deterministic in (False, True):
        episodes = run_episodes(env, agent, state, key, 2, deterministic, watch)
        starts[deterministic] = np.asarray(episodes.start.robot_xy)
        positions, goal = (np.asarray(rows) for rows in episodes.watched)
        np.testing.assert_array_equal(positions[0], starts[deterministic])
        moves = np.diff(positions, axis=0)
        expected = 0.15 * np.clip(goal[:-1] - positions[:-1], -1.0, 1.0)
        actions[deterministic] = np.abs(moves - expected).max()
    np.testing.assert_array_equal(starts[False], starts[True])
    assert actions[True] < ROUNDING
    assert actions[False] > 0.01


def test_failed_episodes_count_for_nothing(state, key):
    """Worlds that start on the left break half-way; their costs do not violate."""
    env = make_toy_env(
        fails=lambda layout, age: (layout.goal_xy[0] < 0) & (age > NUM_STEPS // 2)
    )
    agent = linear_agent(env)
    episodes = jax.jit(lambda s, k: run_episodes(env, agent, s, k, 40))(state, key)
    result = score(episodes)
    broken = np.asarray(episodes.start.goal_xy)[:, 0] < 0
    assert 0 < broken.sum() < 40
    np.testing.assert_array_equal(result.valid, 1.0 - broken)
    assert (np.asarray(episodes.valid).sum(axis=0)[broken] == NUM_STEPS // 2).all()
    violates = np.asarray(result.ep_cost) > 0
    assert violates[broken].any()
    expected = violates[~broken].mean()
    assert float(result.violation_rate) == pytest.approx(expected)
    assert expected != pytest.approx(violates.mean())


def test_of_no_valid_episode_nothing_is_known(state, key):
    env = make_toy_env(fails=lambda layout, age: age > 0)
    agent = linear_agent(env)
    result = evaluate(env, agent, state, key, 2)
    assert result.valid.tolist() == [0.0, 0.0]
    assert np.isnan(result.violation_rate)
    row = eval_summary(result)
    assert row["episodes"] == 0
    known = [name for name, value in row.items() if not np.isnan(value)]
    assert known == ["episodes"]
    assert "of no valid episode nothing is known" in score_line("broken", row)


def test_evaluate_is_compiled_once(state, key):
    env = make_toy_env()
    size = evaluate._cache_size  # pyright: ignore
    agent, before = linear_agent(env), size()
    first, second = (evaluate(env, agent, state, k, 2) for k in jax.random.split(key))
    assert size() == before + 1
    assert not np.array_equal(first.ep_return, second.ep_return)


@pytest.mark.parametrize("count", [0, -1, 1.5, None])
def test_no_episodes_are_refused(state, key, count):
    env = make_toy_env()
    with pytest.raises(ValueError, match=r"^num_episodes must be an integer in \[1"):
        evaluate(env, linear_agent(env), state, key, count)
