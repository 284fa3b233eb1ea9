"""A point mass with the face of an `Env`, and slots for it: compiles in seconds.

The goal lies in the middle of the only hazard, so what earns reward costs: plain PPO
drives into it, a constrained learner stops at its rim.
"""

import dataclasses
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from autocost_jax.agents.base import Agent, EnvSizes
from autocost_jax.config import AgentConfig, EnvConfig, SearchConfig, TrainConfig
from autocost_jax.costs import training_cost
from autocost_jax.envs.env import Env
from autocost_jax.records import (
    CostInputs,
    EnvState,
    Layout,
    Metrics,
    Slot,
    TrainingCost,
)

NUM_STEPS = 16
SPEED = 0.15  # metres a step at full throttle
RADIUS = 0.5  # of the hazard
ARENA = 1.5  # half the side of the square in which everything starts
BINS = 8

AGENT = AgentConfig(
    hidden_sizes=(8,),
    policy_passes=2,
    policy_minibatches=2,
    value_passes=2,
    value_minibatches=2,
)
TRAIN = TrainConfig(
    env=EnvConfig(num_steps=NUM_STEPS),
    agent=AGENT,
    num_worlds=4,
    num_epochs=2,
)
SEARCH = SearchConfig(
    train=TRAIN,
    population_size=4,
    num_elites=2,
    num_stages=2,
    fitness_epochs=1,
)


class Counter:
    """How often the Python code of `step` has run, that is, been traced."""

    def __init__(self) -> None:
        self.steps = 0


def make_toy_env(
    num_steps: int = NUM_STEPS,
    fails: Callable[[Layout, jax.Array], jax.Array] | None = None,
    counter: Counter | None = None,
) -> Env:
    """The environment.

    Args:
      num_steps: episode length.
      fails: (layout before the step, age after it) -> bool, when a world breaks.
      counter: counts the traces of `step`.
    """

    def reset(key: jax.Array) -> EnvState:
        key_robot, key_goal, key_state = jax.random.split(key, 3)
        robot, goal = (
            jax.random.uniform(k, (2,), minval=-ARENA, maxval=ARENA)
            for k in (key_robot, key_goal)
        )
        zero = jnp.zeros(())
        layout = Layout(robot, zero, goal, goal[None], jnp.zeros((0, 2)), goal, zero)
        return reset_to(layout, key_state)

    def reset_to(layout: Layout, key: jax.Array) -> EnvState:
        zero, no = jnp.zeros(()), jnp.zeros((), bool)
        distance, lidar = _see(layout)
        return EnvState(
            data={"position": layout.robot_xy},
            layout=layout,
            obs=_observe(layout, lidar),
            reward=zero,
            cost=zero,
            done=no,
            failed=no,
            age=jnp.zeros((), jnp.int32),
            task_distances=distance,
            cost_inputs=CostInputs(
                zero, lidar, distance, distance, jnp.full((), RADIUS)
            ),
            metrics={
                "goals_met": jnp.zeros((), jnp.int32),
                "goal_move_failures": jnp.zeros((), jnp.int32),
                "distance_travelled": zero,
                "steps_outside": jnp.zeros((), jnp.int32),
            },
            key=key,
        )

    def step(state: EnvState, action: jax.Array) -> EnvState:
        if counter is not None:
            counter.steps += 1
        move = SPEED * jnp.clip(action, -1.0, 1.0)
        position = state.data["position"] + move
        layout = state.layout.replace(robot_xy=position)
        distance, lidar = _see(layout)
        age = state.age + 1
        failed = state.failed | ~jnp.isfinite(position).all()
        if fails is not None:
            failed |= fails(state.layout, age)
        cost = jnp.maximum(RADIUS - distance, 0.0)
        counters = state.metrics

        def live(x: jax.Array) -> jax.Array:
            return jnp.where(failed, jnp.zeros_like(x), x)

        return state.replace(
            data={"position": jnp.where(failed, jnp.nan, position)},
            layout=jax.tree.map(
                lambda old, new: jnp.where(failed, old, new), state.layout, layout
            ),
            obs=live(_observe(layout, lidar)),
            reward=live(state.task_distances - distance),
            cost=live(cost),
            done=age == num_steps,
            failed=failed,
            age=age,
            task_distances=live(distance),
            cost_inputs=CostInputs(
                live(cost),
                live(lidar),
                live(distance),
                live(state.cost_inputs.distance),
                state.cost_inputs.radius,
            ),
            metrics={
                "goals_met": counters["goals_met"] + (live(cost) > 0),
                "goal_move_failures": counters["goal_move_failures"],
                "distance_travelled": counters["distance_travelled"]
                + live(jnp.sqrt((move**2).sum())),
                "steps_outside": counters["steps_outside"]
                + (jnp.abs(layout.robot_xy) > ARENA).any(),
            },
        )

    return Env(
        reset=reset,
        reset_to=reset_to,
        step=step,
        observation_size=4 + BINS,
        action_size=2,
        episode_length=num_steps,
        dt=0.1,
        obs_slices=MappingProxyType({"hazards_lidar": slice(4, 4 + BINS)}),
        config=EnvConfig(num_steps=num_steps),
    )


def _see(layout: Layout) -> tuple[jax.Array, jax.Array]:
    """Distance to the hazard, and a lidar of it: one bin, exponential."""
    offset = layout.hazards[0] - layout.robot_xy
    distance = jnp.sqrt((offset**2).sum())
    angle = jnp.arctan2(offset[1], offset[0]) % (2 * jnp.pi)
    index = jnp.floor(angle / (2 * jnp.pi) * BINS).astype(jnp.int32) % BINS
    return distance, jnp.exp(-distance) * (jnp.arange(BINS) == index)


def _observe(layout: Layout, lidar: jax.Array) -> jax.Array:
    offset = layout.hazards[0] - layout.robot_xy
    return jnp.concatenate([layout.robot_xy, offset, lidar])


class LinearState(struct.PyTreeNode):
    """State of `linear_agent`: weights [O, U] and epochs learnt."""

    weights: jax.Array
    epochs: jax.Array


def linear_agent(env: EnvSizes, lr: float = 1.0, broken_epoch: int = -1) -> Agent:
    """A user's own agent, one REINFORCE step an epoch: compiles in a second.

    It has no critic and weighs costs by `constrained`. In epoch `broken_epoch` it
    loses its mind if `constrained` is above 1.
    """

    def init(key: jax.Array) -> Any:
        shape = (env.observation_size, env.action_size)
        weights = 0.1 * jax.random.normal(key, shape)
        return LinearState(weights, jnp.zeros((), jnp.int32))

    def policy(state, obs, key, deterministic=False):
        mean = obs @ state.weights
        noise = jax.random.normal(key, mean.shape)
        return mean if deterministic else mean + 0.5 * noise

    def update(state, trajectory, total_cost, slot, key) -> tuple[Any, Metrics]:
        del key
        obs, valid = trajectory.obs[:-1], trajectory.valid
        score = trajectory.reward - 4.0 * slot.constrained * total_cost
        ahead = jnp.cumsum((score * valid)[::-1], axis=0)[::-1]
        advantage = valid * (ahead - jnp.mean(ahead, axis=1, keepdims=True))
        noise = trajectory.action - obs @ state.weights
        gradient = jnp.einsum("tno,tnu,tn->ou", obs, noise, advantage)
        gradient = gradient / jnp.maximum(jnp.sum(valid), 1.0)
        breaks = (state.epochs == broken_epoch) & (slot.constrained > 1.0)
        gradient = jnp.where(breaks, jnp.nan, gradient)
        after = LinearState(state.weights + lr * gradient, state.epochs + 1)
        return after, {"gradient": jnp.sqrt(jnp.sum(gradient**2))}

    return Agent(init, policy, update)


def train_config(**changes) -> TrainConfig:
    """`TRAIN` with some fields changed."""
    return dataclasses.replace(TRAIN, **changes)


def search_config(**changes) -> SearchConfig:
    """`SEARCH` with some fields changed."""
    return dataclasses.replace(SEARCH, **changes)


def make_slot(
    seed: int = 0,
    method: str = "extrinsic",
    theta: jax.Array | None = None,
    limit: float = 0.0,
    constrained: float = 1.0,
) -> Slot:
    """One slot."""
    return Slot(
        cost=training_cost(method, theta, limit),
        key=jax.random.key(seed),
        constrained=jnp.asarray(constrained, jnp.float32),
    )


def intrinsic_slots(num_slots: int, seed: int = 0) -> Slot:
    """Slots [P] that differ in their network and in their key."""
    key_theta, key_slots = jax.random.split(jax.random.key(seed))
    one = training_cost("extrinsic+intrinsic", jnp.zeros(41))
    cost: TrainingCost = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (num_slots, *x.shape)), one
    )
    theta = 3.0 * jax.random.normal(key_theta, (num_slots, 41))
    return Slot(
        cost=cost.replace(theta=theta),
        key=jax.random.split(key_slots, num_slots),
        constrained=jnp.ones(num_slots, jnp.float32),
    )
