"""Training one slot and many: learning, metrics, freezing, and a user's own parts."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from autocost_jax.agents import cpo, ppo_lagrangian
from autocost_jax.costs import BANK, CostTerm, intrinsic_cost, training_cost
from autocost_jax.metrics import cost_by_distance, episode_metrics
from autocost_jax.population import stack_slots
from autocost_jax.records import CostInputs, Slot, Trajectory
from autocost_jax.train import (
    EpochState,
    final_episodes,
    init_learner,
    run_epoch,
    run_stage,
    train,
)
from toys import (
    AGENT,
    NUM_STEPS,
    TRAIN,
    linear_agent,
    make_slot,
    make_toy_env,
    train_config,
)

ALGORITHMS = {"ppo_lagrangian": ppo_lagrangian, "cpo": cpo}
ACROSS_PROGRAMS = 1e-5  # one update of float32 sums in another order
ROUNDING = 1e-5  # float32 sums of 64 rows against NumPy float64

# Episodes of 16 steps: with the paper's 0.99 arriving late would cost nothing.
LEARNING = train_config(
    agent=dataclasses.replace(
        AGENT,
        gamma=0.9,
        gae_lambda=0.9,
        cost_gamma=0.9,
        cost_gae_lambda=0.9,
        policy_lr=3e-3,
        target_kl=0.03,
        policy_passes=16,
        policy_minibatches=1,
        value_lr=1e-2,
        value_passes=16,
        value_minibatches=1,
    ),
    num_worlds=32,
    num_epochs=50,
)
FREE, BOUND = 0, 1  # slots: no cost counts; its extrinsic cost does


@pytest.fixture(scope="module")
def env():
    return make_toy_env()


@pytest.fixture(scope="module", params=ALGORITHMS)
def learnt(request, env):
    """Agent, slots, states and metrics [2, E] of a free and a bound slot."""
    agent = ALGORITHMS[request.param](LEARNING.agent, env)
    # A limit never reached frees CPO, which does not look at `constrained`.
    slots = stack_slots([make_slot(limit=1e6, constrained=0.0), make_slot()])
    run = jax.jit(jax.vmap(lambda slot: train(env, agent, slot, LEARNING)))
    states, metrics = run(slots)
    return agent, slots, states, jax.tree.map(np.asarray, metrics)


def test_training_raises_the_return(learnt):
    ep_return = learnt[3]["ep_return"][FREE]
    assert ep_return[-5:].mean() > ep_return[:5].mean() + 0.5


def test_a_constraint_lowers_the_cost(learnt):
    cost = learnt[3]["ep_cost"][:, -5:].mean(axis=1)
    assert cost[FREE] > 1.0  # the goal lies in the hazard
    assert cost[BOUND] < 0.5 * cost[FREE]


def test_one_metric_an_epoch_and_all_finite(learnt):
    for name, values in learnt[3].items():
        assert values.shape == (2, LEARNING.num_epochs), name
        assert values.dtype == np.float32, name
        assert np.isfinite(values).all(), name
    assert not learnt[3]["frozen"].any()


def test_alone_as_among_others(env):
    """vmap(train) over slots is train of each: one update, rounding apart."""
    config = train_config(num_epochs=1)
    agent = linear_agent(env)
    slots = stack_slots([make_slot(seed) for seed in range(3)])

    def one(slot):
        return train(env, agent, slot, config)

    together = jax.jit(jax.vmap(one))(slots)
    alone = jax.jit(one)(jax.tree.map(lambda x: x[1], slots))
    for many, single in zip(
        jax.tree.leaves(together), jax.tree.leaves(alone), strict=True
    ):
        assert many.shape == (3, *single.shape)
        np.testing.assert_allclose(many[1], single, atol=ACROSS_PROGRAMS)


# Metrics ---------------------------------------------------------------------


def make_trajectory(key, valid):
    """Random rewards and costs in two kinds of places: near and far."""
    keys = jax.random.split(key, 5)
    shape = valid.shape
    distance = jax.random.uniform(keys[2], shape, minval=0.2, maxval=4.0)
    return Trajectory(
        obs=jnp.zeros((shape[0] + 1, shape[1], 3)),
        action=jnp.zeros((*shape, 2)),
        reward=jax.random.normal(keys[0], shape),
        cost_inputs=CostInputs(
            cost=jnp.maximum(jax.random.normal(keys[1], shape) - 1.5, 0.0),
            constraint_lidar=jax.random.uniform(keys[3], (*shape, 8)),
            distance=distance,
            previous_distance=distance,
            radius=jnp.ones(shape),
        ),
        valid=valid,
    )


def test_metrics_of_whole_episodes(key):
    """The mean of episode sums, and means over states, by a loop."""
    trajectory = make_trajectory(key, jnp.ones((10, 6)))
    theta = jax.random.normal(key, (41,))
    total = jax.random.uniform(key, (10, 6))
    got = episode_metrics(trajectory, total, 10) | cost_by_distance(trajectory, theta)
    inputs = jax.tree.map(lambda x: np.asarray(x, np.float64), trajectory.cost_inputs)
    sums = {
        "ep_return": np.asarray(trajectory.reward, np.float64).sum(axis=0),
        "ep_cost": inputs.cost.sum(axis=0),
        "ep_total_cost": np.asarray(total, np.float64).sum(axis=0),
    }
    for name, episodes in sums.items():
        assert float(got[name]) == pytest.approx(episodes.mean(), abs=ROUNDING), name
    expected = (sums["ep_cost"] > 0).mean()
    assert 0 < expected < 1
    assert float(got["violating_worlds"]) == pytest.approx(expected)
    intrinsic = intrinsic_cost(theta, trajectory.cost_inputs.constraint_lidar)
    for name, where in (
        ("intrinsic_far", inputs.distance > 3.0),
        ("intrinsic_near", inputs.distance < 1.5),
    ):
        assert 0 < where.mean() < 1
        mean = np.asarray(intrinsic)[where].mean()
        assert float(got[name]) == pytest.approx(mean, abs=ROUNDING), name


def test_metrics_leave_failed_steps_out(key):
    """Rates of the valid steps times the length; worlds that failed are counted."""
    valid = jnp.ones((10, 6)).at[4:, 1].set(0.0).at[:, 5].set(0.0)
    trajectory = make_trajectory(key, valid)
    got = episode_metrics(trajectory, trajectory.reward, 10)
    kept = np.asarray(trajectory.reward)[np.asarray(valid) > 0]
    assert kept.size == 44
    assert float(got["ep_return"]) == pytest.approx(10 * kept.mean(), abs=ROUNDING)
    assert float(got["failed_worlds"]) == 2


def test_what_no_world_has_shown_is_nan(key):
    """Not 0, which would be the best cost."""
    trajectory = make_trajectory(key, jnp.zeros((10, 6)))
    got = episode_metrics(trajectory, trajectory.reward, 10)
    assert float(got.pop("failed_worlds")) == 6
    assert np.isnan(list(got.values())).all()


def test_nowhere_far_or_near_is_nan(key):
    trajectory = make_trajectory(key, jnp.ones((4, 2)))
    inputs = trajectory.cost_inputs.replace(distance=jnp.full((4, 2), 2.0))
    trajectory = trajectory.replace(cost_inputs=inputs)
    got = cost_by_distance(trajectory, jnp.zeros(41))
    assert np.isnan(got["intrinsic_far"])
    assert np.isnan(got["intrinsic_near"])


def test_counters_are_means_over_episodes(env):
    """One epoch of four segments still reports counts of a whole episode."""
    agent = linear_agent(env, lr=0.0)
    slot = make_slot()
    rates = []
    for segments, worlds in ((1, 64), (4, 16)):
        config = train_config(
            segments_per_episode=segments, num_worlds=worlds, num_epochs=4
        )
        metrics = jax.jit(lambda s, c=config: train(env, agent, s, c))(slot)[1]
        rates.append(float(jnp.mean(metrics["distance_travelled"])))
    # Each of 16 steps moves at most 0.15 m along each axis.
    assert 0.5 < rates[0] < NUM_STEPS * 0.15 * np.sqrt(2)
    assert rates[1] == pytest.approx(rates[0], rel=0.1)  # other worlds: statistics


# Freezing --------------------------------------------------------------------

BROKEN_EPOCH = 2


def test_a_broken_agent_keeps_its_last_finite_state(env):
    """Slots: a healthy one, one that goes mad in epoch 2, one whose cost is NaN."""
    agent = linear_agent(env, broken_epoch=BROKEN_EPOCH)
    slots = stack_slots(
        [
            make_slot(),
            make_slot(constrained=2.0),
            make_slot(method="intrinsic", theta=jnp.full(41, jnp.nan)),
        ]
    )
    first = jax.vmap(lambda slot: init_learner(agent, slot))(slots)

    @jax.jit
    def epochs(learner):
        def body(state, epoch):
            state, (metrics,) = run_epoch(env, (agent,), TRAIN, state, (slots,), epoch)
            return state, (state.learners[0], metrics["frozen"])

        return jax.lax.scan(
            body, EpochState((learner,)), jnp.arange(5, dtype=jnp.int32)
        )[1]

    after, frozen = epochs(first)
    assert frozen.T.tolist() == [[0] * 5, [0, 0, 1, 1, 1], [1] * 5]
    assert after.frozen[-1].tolist() == [False, True, True]
    assert after.frozen_epoch[-1].tolist() == [-1, BROKEN_EPOCH, 0]
    assert after.agent.epochs[-1].tolist() == [5, BROKEN_EPOCH, 0]
    weights = np.asarray(after.agent.weights)
    assert np.isfinite(weights).all()
    np.testing.assert_array_equal(weights[-1, 1], weights[BROKEN_EPOCH - 1, 1])
    np.testing.assert_array_equal(weights[-1, 2], first.agent.weights[2])
    assert not np.array_equal(weights[-1, 0], weights[BROKEN_EPOCH - 1, 0])


def test_no_valid_world_freezes():
    broken = make_toy_env(fails=lambda layout, age: age > 0)
    agent = linear_agent(broken)
    config = train_config(num_epochs=2)
    slots = stack_slots([make_slot()])
    learners = jax.vmap(lambda slot: init_learner(agent, slot))(slots)
    after, metrics = jax.jit(
        lambda x: run_stage(broken, (agent,), config, (x,), (slots,))
    )(learners)
    assert after[0].frozen_epoch.tolist() == [0]
    np.testing.assert_array_equal(after[0].agent.weights, learners.agent.weights)
    assert metrics[0]["failed_worlds"].tolist() == [[config.num_worlds]] * 2


def test_some_failed_worlds_do_not_freeze():
    """Half the arena is deadly; the slot learns from the other half."""
    env = make_toy_env(fails=lambda layout, age: layout.robot_xy[0] > 0)
    agent, config = linear_agent(env), train_config(num_worlds=16)
    state, metrics = jax.jit(lambda slot: train(env, agent, slot, config))(make_slot())
    assert int(state.epochs) == config.num_epochs
    assert not metrics["frozen"].any()
    assert all(0 < n < config.num_worlds for n in metrics["failed_worlds"])


# Lengths of an episode -------------------------------------------------------


@pytest.mark.parametrize("segments", [1, 2])
@pytest.mark.parametrize("function", ["train", "run_stage", "run_epoch", "final"])
def test_an_environment_of_another_length_is_refused(function, segments):
    """While tracing, by everything that takes both; the message has both lengths."""
    env = make_toy_env(5 * NUM_STEPS)
    agent, config = linear_agent(env), train_config(segments_per_episode=segments)
    slot = make_slot()
    slots = (jax.tree.map(lambda x: x[None], slot),)
    fresh = (jax.vmap(lambda slot: init_learner(agent, slot))(slots[0]),)
    calls = {
        "train": lambda: train(env, agent, slot, config),
        "run_stage": lambda: run_stage(env, (agent,), config, fresh, slots),
        "run_epoch": lambda: run_epoch(
            env,
            (agent,),
            config,
            EpochState(fresh),
            slots,
            jnp.zeros((), jnp.int32),
        ),
        "final": lambda: final_episodes(env, (agent,), config, fresh, slots, 1),
    }
    with pytest.raises(ValueError, match=r"episodes of 80 steps.* of 16 \("):
        jax.eval_shape(calls[function])


def test_an_environment_needs_no_configuration_of_its_own(env):
    """A user's own may be any object with the functions and the sizes."""
    names = ("reset", "step", "observation_size", "action_size", "episode_length")
    bare: Any = SimpleNamespace(**{name: getattr(env, name) for name in names})
    agent, config = linear_agent(env), train_config(num_epochs=1)
    _, metrics = jax.jit(lambda slot: train(bare, agent, slot, config))(make_slot())
    _, expected = jax.jit(lambda slot: train(env, agent, slot, config))(make_slot())
    np.testing.assert_array_equal(metrics["ep_return"], expected["ep_return"])


# A user's own parts ----------------------------------------------------------


def test_own_environment_agent_and_cost_term_plug_in(env):
    """The toy environment and agent, and a term that fines standing far out."""
    term = CostTerm("outside", lambda inputs, theta: 0.2 * (inputs.distance > 1.0))
    bank = (*BANK, term)
    agent = linear_agent(env)
    config = train_config(num_epochs=30, num_worlds=16)
    slot = Slot(
        cost=training_cost("outside", bank=bank),
        key=jax.random.key(3),
        constrained=jnp.ones(()),
    )
    state, metrics = jax.jit(lambda s: train(env, agent, s, config, bank))(slot)
    assert int(state.epochs) == config.num_epochs
    assert "gradient" in metrics
    total = np.asarray(metrics["ep_total_cost"])
    assert total[-5:].mean() < 0.8 * total[:5].mean()  # the fine teaches it
