"""One contract for every algorithm, and probes whose answers are known."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_toys import FULL_BATCH, SMALL, Sizes, act, make_slot, make_trajectory

from autocost_jax.agents import cpo, ppo_lagrangian

AGENTS = {"ppo_lagrangian": ppo_lagrangian, "cpo": cpo}
MODES = {"minibatch": SMALL, "full": FULL_BATCH}
ACROSS_PROGRAMS = 1e-5  # one update, other batch shapes: rounding of float32 sums
LONG_CRITICS = dataclasses.replace(FULL_BATCH, value_passes=600, value_lr=3e-3)


@pytest.fixture(params=AGENTS)
def make_agent(request):
    return AGENTS[request.param]


@pytest.fixture(params=MODES)
def config(request):
    return MODES[request.param]


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
    return jax.vmap(one)(keys, jnp.arange(num_slots, dtype=jnp.float32))


def test_update_keeps_types_and_is_finite_with_one_trace(make_agent, config):
    agent = make_agent(config, Sizes())
    state, trajectory, cost, slot, key = stack_problem(agent)
    chex.clear_trace_counter()
    update = jax.jit(chex.assert_max_traces(jax.vmap(agent.update), n=1))
    new, metrics = update(state, trajectory, cost, slot, key)
    newer, _ = update(new, trajectory, cost, slot, key)
    assert types(new) == types(state) == types(newer)
    for leaf in jax.tree.leaves((newer, metrics)):
        assert np.all(np.isfinite(leaf))
    for name, value in metrics.items():
        assert value.shape == (4,), name
        assert value.dtype == jnp.float32, name
    np.testing.assert_allclose(
        metrics["j_c"], cost.sum(1).mean(-1), rtol=1e-5
    )  # whole episodes: the mean episode sum
    changed = jax.tree.map(lambda a, b: np.any(a != b), state.critic, new.critic)
    assert all(jax.tree.leaves(changed))


def test_a_nan_slot_harms_nobody(make_agent, config):
    agent = make_agent(config, Sizes())
    state, trajectory, cost, slot, key = stack_problem(agent)
    update = jax.jit(jax.vmap(agent.update))
    clean = update(state, trajectory, cost, slot, key)
    poisoned = trajectory.replace(
        obs=trajectory.obs.at[1].set(jnp.nan),
        reward=trajectory.reward.at[2].set(jnp.inf),
    )
    dirty = update(state, poisoned, cost.at[1].set(jnp.nan), slot, key)
    for lane in (0, 3):
        chex.assert_trees_all_equal(
            *(jax.tree.map(lambda leaf: leaf[lane], out) for out in (clean, dirty))
        )


def test_what_an_invalid_world_holds_changes_nothing(make_agent, config):
    agent = make_agent(config, Sizes())
    args = jax.tree.map(lambda leaf: leaf[0], stack_problem(agent))
    state, trajectory, cost, slot, key = args
    valid = trajectory.valid.at[7:, 2].set(0.0).at[:, 5].set(0.0)
    update = jax.jit(agent.update)
    clean = update(state, trajectory.replace(valid=valid), cost, slot, key)
    dead = valid == 0
    broken = make_trajectory(
        # s_7 of world 2 was reached by a valid step; what follows is garbage
        trajectory.obs.at[8:, 2].set(jnp.nan).at[1:, 5].set(jnp.inf),
        jnp.where(dead[..., None], jnp.nan, trajectory.action),
        jnp.where(dead, jnp.nan, trajectory.reward),
        valid,
    )
    dirty = update(state, broken, jnp.where(dead, jnp.inf, cost), slot, key)
    chex.assert_trees_all_equal(clean, dirty)
    assert dirty[1]["valid_fraction"] == pytest.approx((160 - 13 - 20) / 160)


def test_an_invalid_world_is_as_good_as_none(make_agent):
    agent = make_agent(FULL_BATCH, Sizes())
    args = jax.tree.map(lambda leaf: leaf[0], stack_problem(agent))
    state, trajectory, cost, slot, key = args
    valid = trajectory.valid.at[:, 6:].set(0.0)
    with_dead = agent.update(state, trajectory.replace(valid=valid), cost, slot, key)
    fewer = make_trajectory(
        trajectory.obs[:, :6], trajectory.action[:, :6], trajectory.reward[:, :6]
    )
    without = agent.update(state, fewer, cost[:, :6], slot, key)
    for a, b in zip(*map(jax.tree.leaves, (with_dead[0], without[0])), strict=True):
        np.testing.assert_allclose(a, b, atol=ACROSS_PROGRAMS)
    assert with_dead[1]["j_c"] == pytest.approx(float(without[1]["j_c"]), rel=1e-5)


def test_no_valid_world_stays_finite(make_agent, config):
    agent = make_agent(config, Sizes())
    args = jax.tree.map(lambda leaf: leaf[0], stack_problem(agent))
    state, trajectory, cost, slot, key = args
    dead = trajectory.replace(valid=jnp.zeros_like(trajectory.valid))
    new, metrics = jax.jit(agent.update)(state, dead, cost, slot, key)
    for leaf in jax.tree.leaves((new, metrics)):
        assert np.all(np.isfinite(leaf))
    assert metrics["valid_fraction"] == 0


def test_vmap_agrees_with_one_slot_at_a_time(make_agent):
    agent = make_agent(FULL_BATCH, Sizes())
    args = stack_problem(agent, 2)
    together = jax.jit(jax.vmap(agent.update))(*args)[0]
    for lane in range(2):
        alone = jax.jit(agent.update)(*jax.tree.map(lambda x: x[lane], args))[0]
        for a, b in zip(*map(jax.tree.leaves, (together, alone)), strict=True):
            np.testing.assert_allclose(a[lane], b, atol=ACROSS_PROGRAMS)


def test_policy_samples_unless_told_otherwise(make_agent):
    agent = make_agent(SMALL, Sizes())
    state = agent.init(jax.random.key(0))
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
    args = jax.tree.map(lambda leaf: leaf[0], stack_problem(agent))
    with pytest.raises(ValueError, match="divide the 160 rows.*got 7"):
        agent.update(*args)


# --- probes: a failure names the culprit -----------------------------------------


def test_critics_learn_the_discounted_sum_to_the_bootstrap(make_agent):
    """Obs = time; gamma small, so the rows' value is a known function of time."""
    config = dataclasses.replace(
        LONG_CRITICS, gamma=0.5, cost_gamma=0.25, policy_lr=1e-9
    )
    sizes = Sizes(observation_size=1, action_size=1, episode_length=10)
    agent = make_agent(config, sizes)
    state = agent.init(jax.random.key(0))
    time = jnp.arange(11) / 10
    obs = jnp.broadcast_to(time[:, None, None], (11, 4, 1))
    action = agent.policy(state, obs[:-1], jax.random.key(1))
    reward = jnp.broadcast_to((jnp.arange(10) == 9)[:, None] * 1.0, (10, 4))
    trajectory = make_trajectory(obs, action, reward)
    cost = jnp.ones_like(reward)  # constant: value 1 / (1 - 0.25) at every time
    update = jax.jit(agent.update)
    for i in range(5):
        key = jax.random.key(i)
        state, metrics = update(state, trajectory, cost, make_slot(), key)
    networks_value = metrics["value_loss"], metrics["cost_value_loss"]
    # r at the last step only and a bootstrap that must satisfy nothing but itself:
    # the fit of 10 targets by 16 tanh units, after 3000 steps
    assert networks_value[0] < 2e-3
    assert networks_value[1] < 2e-3
    assert metrics["j_c"] == pytest.approx(10.0)


def run_bandit(agent, steps, limit, constrained=1.0, coefficients=(1.0, 1.0)):
    """Mean action after `steps` updates: reward = action 0, cost = max(action 1, 0)."""
    sizes = Sizes()
    state = agent.init(jax.random.key(0))
    update = jax.jit(agent.update)
    metrics = []
    start = agent.policy(state, jnp.full((3,), 0.5), None, deterministic=True)
    for i in range(steps):
        key_act, key_update = jax.random.split(jax.random.key(i))
        obs, action = act(agent, state, key_act, sizes, num_worlds=32)
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
    moved, metrics = run_bandit(make_agent(PROBE, Sizes()), 12, 1e3, constrained=0.0)
    assert moved[0] > 0.5
    assert metrics[-1]["kl"] < 0.05


def test_cost_gradient_lowers_the_costly_action(make_agent):
    moved, metrics = run_bandit(
        make_agent(PROBE, Sizes()), 12, 0.0, coefficients=(0.0, 1.0)
    )
    assert moved[1] < -0.2
    assert metrics[-1]["j_c"] < 0.7 * metrics[0]["j_c"]
    assert metrics[0]["multiplier"] > 0


def test_ppo_ignores_cost_where_ppo_lagrangian_does_not():
    agent = ppo_lagrangian(PROBE, Sizes())
    free, _ = run_bandit(agent, 8, 0.0, 0.0, coefficients=(0.0, 1.0))
    held, _ = run_bandit(agent, 8, 0.0, 1.0, coefficients=(0.0, 1.0))
    assert abs(free[1]) < 0.1
    assert held[1] < -0.15


def test_cpo_recovers_within_its_bounds():
    """Infeasible from the start: recovery steps, accepted, inside KL and cost."""
    _, metrics = run_bandit(cpo(PROBE, Sizes()), 10, 0.5)
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
