"""One contract for every algorithm, and probes whose answers are known."""

import dataclasses
import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import FULL_BATCH, SIZES, SMALL, Sizes, act, make_slot, make_trajectory

from autocost_jax.agents import Agent, cpo, focops, ppo_lagrangian
from autocost_jax.agents.networks import make_networks

AGENTS = {"ppo_lagrangian": ppo_lagrangian, "cpo": cpo}
MODES = {"minibatch": SMALL, "full": FULL_BATCH}
ACROSS_PROGRAMS = 1e-5  # one update, other batch shapes: rounding of float32 sums
LONG_CRITICS = dataclasses.replace(FULL_BATCH, value_passes=400, value_lr=3e-3)


@pytest.fixture(params=AGENTS)
def make_agent(request):
    return AGENTS[request.param]


class Problem(NamedTuple):
    agent: Agent
    update: Any  # compiled once for all tests, [4, ...] in and out
    args: tuple[Any, ...]  # state, trajectory, cost, slot, key
    clean: Any  # what update gives for args


PROBLEMS = [(a, m) for a in AGENTS for m in MODES] + [("focops", "minibatch")]


@pytest.fixture(scope="module", params=PROBLEMS)
def problem(request):
    name, mode = request.param
    agent = {**AGENTS, "focops": focops}[name](MODES[mode], SIZES)
    chex.clear_trace_counter()
    update = jax.jit(jax.vmap(chex.assert_max_traces(agent.update, n=1)))
    args = stack_problem(agent)
    return Problem(agent, update, args, update(*args))


def pick(tree, lane):
    return jax.tree.map(lambda leaf: leaf[lane], tree)


def types(tree):
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type), tree)


def stack_problem(agent, num_slots=4):
    """Stacked (state, trajectory, cost, slot, key) of different random slots."""

    def one(key, limit):
        key_init, key_act, key_update = jax.random.split(key, 3)
        state = agent.init(key_init)
        obs, action = act(agent, state, key_act)
        trajectory = make_trajectory(obs, action, action[..., 0])
        cost = jnp.maximum(action[..., 1], 0.0)
        return state, trajectory, cost, make_slot(limit), key_update

    keys = jax.random.split(jax.random.key(0), num_slots)
    return jax.jit(jax.vmap(one))(keys, jnp.arange(num_slots, dtype=jnp.float32))


def test_update_keeps_types_and_is_finite_with_one_trace(problem):
    state, trajectory, cost, slot, key = problem.args
    new, metrics = problem.clean
    newer, _ = problem.update(new, trajectory, cost, slot, key)
    assert types(new) == types(state) == types(newer)
    for leaf in jax.tree.leaves((newer, metrics)):
        assert np.all(np.isfinite(leaf))
    for name, value in metrics.items():
        assert value.shape == (4,), name
        assert value.dtype == jnp.float32, name
    # whole episodes: the mean episode sum
    np.testing.assert_allclose(metrics["j_c"], cost.sum(1).mean(-1), rtol=1e-5)
    changed = jax.tree.map(lambda a, b: np.any(a != b), state.critic, new.critic)
    assert all(jax.tree.leaves(changed))


@pytest.mark.parametrize("problem", [("cpo", "full")], indirect=True)
def test_violation_factor_is_worth_a_lower_limit(problem):
    """k (J_c - d) = J_c - d' with d' = k d - (k - 1) J_c; below the limit nothing."""
    state, trajectory, cost, slot, key = problem.args
    factor, measured = 2.0, cost.sum(1).mean(-1)
    config = dataclasses.replace(FULL_BATCH, violation_factor=factor)
    update = jax.jit(jax.vmap(cpo(config, SIZES).update))

    def learn(update, limit):
        limited = slot.replace(cost=slot.cost.replace(limit=limit))
        new, metrics = update(state, trajectory, cost, limited, key)
        return new.policy, metrics

    above = 0.99 * measured
    plain, strict = learn(problem.update, above), learn(update, above)
    lower, _ = learn(problem.update, factor * above - (factor - 1) * measured)
    chex.assert_trees_all_close(strict[0], lower, rtol=1e-4, atol=1e-5)
    assert not np.allclose(plain[0]["log_std"], strict[0]["log_std"], atol=1e-4)
    np.testing.assert_array_equal(plain[1]["violation"], strict[1]["violation"])
    below = [learn(each, 1.1 * measured)[0] for each in (problem.update, update)]
    chex.assert_trees_all_close(*below, rtol=1e-5, atol=1e-6)


def test_a_nan_slot_harms_nobody(problem):
    state, trajectory, cost, slot, key = problem.args
    poisoned = trajectory.replace(
        obs=trajectory.obs.at[1].set(jnp.nan),
        reward=trajectory.reward.at[2].set(jnp.inf),
    )
    dirty = problem.update(state, poisoned, cost.at[1].set(jnp.nan), slot, key)
    for lane in (0, 3):
        chex.assert_trees_all_equal(pick(problem.clean, lane), pick(dirty, lane))


def test_order_of_slots_changes_nothing(problem):
    order = jnp.array([2, 0, 3, 1])
    shuffled = problem.update(*pick(problem.args, order))
    chex.assert_trees_all_equal(pick(problem.clean, order), shuffled)


def test_what_an_invalid_world_holds_changes_nothing(problem):
    state, trajectory, cost, slot, key = problem.args
    valid = trajectory.valid.at[:, 7:, 2].set(0.0).at[:, :, 5].set(0.0)
    weighted = trajectory.replace(valid=valid)
    clean = problem.update(state, weighted, cost, slot, key)
    dead = valid == 0
    broken = weighted.replace(
        # s_7 of world 2 was reached by a valid step; what follows is garbage
        obs=trajectory.obs.at[:, 8:, 2].set(jnp.nan).at[:, 1:, 5].set(jnp.inf),
        action=jnp.where(dead[..., None], jnp.nan, trajectory.action),
        reward=jnp.where(dead, jnp.nan, trajectory.reward),
    )
    dirty = problem.update(state, broken, jnp.where(dead, jnp.inf, cost), slot, key)
    chex.assert_trees_all_equal(clean, dirty)
    np.testing.assert_allclose(dirty[1]["valid_fraction"], (160 - 13 - 20) / 160)


def test_no_valid_world_stays_finite(problem):
    state, trajectory, cost, slot, key = problem.args
    dead = trajectory.replace(valid=jnp.zeros_like(trajectory.valid))
    new, metrics = problem.update(state, dead, cost, slot, key)
    for leaf in jax.tree.leaves((new, metrics)):
        assert np.all(np.isfinite(leaf))
    assert np.all(metrics["valid_fraction"] == 0)


def test_one_slot_alone_and_an_invalid_world_is_as_good_as_none(make_agent):
    """The same slot: vmapped, alone, with two dead worlds, without them."""
    agent = make_agent(FULL_BATCH, SIZES)
    args = stack_problem(agent, 2)
    state, trajectory, cost, slot, key = args
    valid = trajectory.valid.at[:, :, 6:].set(0.0)
    dead = jax.jit(jax.vmap(agent.update))(
        state, trajectory.replace(valid=valid), cost, slot, key
    )
    fewer = make_trajectory(
        trajectory.obs[:, :, :6],
        trajectory.action[:, :, :6],
        trajectory.reward[..., :6],
    )
    alone = jax.jit(agent.update)
    for lane in range(2):
        without = alone(*pick((state, fewer, cost[..., :6], slot, key), lane))
        got = pick(dead, lane)
        for a, b in zip(*map(jax.tree.leaves, (got[0], without[0])), strict=True):
            np.testing.assert_allclose(a, b, atol=ACROSS_PROGRAMS)
        np.testing.assert_allclose(got[1]["j_c"], without[1]["j_c"], rtol=1e-5)


def test_policy_samples_unless_told_otherwise(make_agent):
    agent = make_agent(SMALL, Sizes())
    state = jax.jit(agent.init)(jax.random.key(0))
    obs = jnp.ones((5000, 3))
    action = agent.policy(state, obs, jax.random.key(1))
    mean = agent.policy(state, obs, jax.random.key(1), deterministic=True)
    assert action.shape == mean.shape == (5000, 2)
    np.testing.assert_array_equal(
        mean, agent.policy(state, obs, jax.random.key(2), deterministic=True)
    )
    np.testing.assert_allclose(action.mean(0), mean[0], atol=0.05)  # 5 sigmas
    np.testing.assert_allclose(action.std(0), np.exp(-0.5), rtol=0.06)
    assert agent.policy(state, obs[0], jax.random.key(1)).shape == (2,)


def test_minibatches_must_divide_the_rows():
    agent = ppo_lagrangian(dataclasses.replace(SMALL, policy_minibatches=7), Sizes())
    args = pick(stack_problem(agent), 0)
    with pytest.raises(ValueError, match=r"divide the 160 rows.*got 7"):
        agent.update(*args)


# --- probes: a failure names the culprit -----------------------------------------


def test_critics_learn_the_discounted_sum_to_the_bootstrap(make_agent):
    """Two states in turn, reward 1 on leaving the first, cost 1 always."""
    config = dataclasses.replace(LONG_CRITICS, gamma=0.5, cost_gamma=0.25)
    sizes = Sizes(observation_size=1, action_size=1, episode_length=10)
    agent = make_agent(config, sizes)
    state = jax.jit(agent.init)(jax.random.key(0))
    where = jnp.arange(11) % 2
    obs = jnp.broadcast_to(where[:, None, None], (11, 4, 1)).astype(float)
    action = agent.policy(state, obs[:-1], jax.random.key(1))
    reward = 1.0 - obs[:-1, :, 0]
    cost = jnp.ones_like(reward)
    trajectory = make_trajectory(obs, action, reward)
    update = jax.jit(agent.update)
    for i in range(4):
        key = jax.random.key(i)
        state, metrics = update(state, trajectory, cost, make_slot(), key)
    networks = make_networks(config, 1, 1)
    value = networks.values(state.critic, jnp.array([[0.0], [1.0]]))
    # V(0) = 1 + V(1) / 2, V(1) = V(0) / 2; V_c = 1 / (1 - 1/4)
    expect = [[4 / 3, 2 / 3], [4 / 3, 4 / 3]]
    np.testing.assert_allclose(value, expect, atol=0.02)  # 0.5^10 of the bootstrap
    assert metrics["j_c"] == pytest.approx(10.0)


@functools.cache
def probe(make):
    """An agent of `PROBE`, initial state, jitted `act` and update, for all probes."""
    agent = make(PROBE, SIZES)
    play = jax.jit(lambda state, key: act(agent, state, key, SIZES, num_worlds=32))
    return agent, jax.jit(agent.init)(jax.random.key(0)), play, jax.jit(agent.update)


def run_bandit(make, steps, limit, constrained=1.0, coefficients=(1.0, 1.0)):
    """Mean action after `steps` updates: reward = action 0, cost = max(action 1, 0)."""
    agent, state, play, update = probe(make)
    metrics = []
    start = agent.policy(state, jnp.full((3,), 0.5), None, deterministic=True)
    for i in range(steps):
        key_act, key_update = jax.random.split(jax.random.key(i))
        obs, action = play(state, key_act)
        trajectory = make_trajectory(obs, action, coefficients[0] * action[..., 0])
        cost = coefficients[1] * jnp.maximum(action[..., 1], 0.0)
        slot = make_slot(limit, constrained)
        state, m = update(state, trajectory, cost, slot, key_update)
        metrics.append(jax.tree.map(float, m))
    end = agent.policy(state, jnp.full((3,), 0.5), None, deterministic=True)
    return np.asarray(end - start), metrics


PROBE = dataclasses.replace(
    SMALL, policy_lr=3e-3, gamma=0.1, cost_gamma=0.1, policy_passes=8
)


def test_reward_gradient_raises_the_rewarded_action(make_agent):
    moved, _ = run_bandit(make_agent, 12, 1e3, constrained=0.0)
    assert moved[0] > 0.5


def test_cost_gradient_lowers_the_costly_action(make_agent):
    moved, metrics = run_bandit(make_agent, 12, 0.0, coefficients=(0.0, 1.0))
    assert moved[1] < -0.2
    assert metrics[-1]["j_c"] < 0.7 * metrics[0]["j_c"]
    assert metrics[0]["multiplier"] > 0


def test_ppo_ignores_cost_where_ppo_lagrangian_does_not():
    free, _ = run_bandit(ppo_lagrangian, 8, 0.0, 0.0, coefficients=(0.0, 1.0))
    held, _ = run_bandit(ppo_lagrangian, 8, 0.0, 1.0, coefficients=(0.0, 1.0))
    assert abs(free[1]) < 0.1
    assert held[1] < -0.15


def test_cpo_recovers_within_its_bounds():
    """Infeasible from the start: recovery steps, accepted, inside KL and cost."""
    _, metrics = run_bandit(cpo, 10, 0.5)
    for m in metrics:
        assert m["kl"] <= PROBE.target_kl
        if m["accepted"]:
            slack = max(-m["violation"], 0.0)
            assert m["cost_surrogate"] <= slack + 1e-6  # mean of centred float32
            assert m["step_fraction"] > 0.1
            assert m["kl"] > 0
        else:
            assert m["kl"] == m["step_fraction"] == 0
    assert metrics[0]["case"] in (0, 1)
    assert metrics[0]["violation"] == pytest.approx((metrics[0]["j_c"] - 0.5) / 20)
    assert np.mean([m["accepted"] for m in metrics]) >= 0.9
    assert metrics[-1]["j_c"] < metrics[0]["j_c"]
