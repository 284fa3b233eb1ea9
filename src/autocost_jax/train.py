"""One epoch of training for groups of slots: unroll -> cost -> update.

A group is the slots of one algorithm, stacked on a leading axis P. All groups of a
population share one rollout, so the physics is traced, compiled and stepped once.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from autocost_jax.agents.base import Agent
from autocost_jax.config import TrainConfig
from autocost_jax.costs import BANK, CostTerm, total_cost
from autocost_jax.envs.env import Env
from autocost_jax.metrics import cost_by_distance, episode_metrics
from autocost_jax.records import EnvState, Key, Metrics, Slot, Trajectory
from autocost_jax.rollout import (
    carry_cohorts,
    join_cohorts,
    reset_worlds,
    unroll_batch,
)

# Purposes of a slot's keys: every key is fold_in(slot.key, epoch, purpose).
INIT, RESET, ACT, UPDATE = range(4)


class Learner(struct.PyTreeNode):
    """One slot's agent and whether it still learns.

    Attributes:
      agent: the agent's own state.
      frozen: [] bool; True once anything of it was non-finite. `agent` is then the
        last finite state.
      frozen_epoch: [] int32 epoch in which that happened, else -1.
    """

    agent: Any
    frozen: jax.Array
    frozen_epoch: jax.Array


class EpochState(struct.PyTreeNode):
    """What one epoch of a population hands to the next.

    Attributes:
      learners: for each group, stacked [P_g, ...].
      worlds: for each group its slots' older cohorts [P_g, (k - 1) N, ...]; None for
        one segment per episode.
    """

    learners: tuple[Learner, ...]
    worlds: tuple[EnvState, ...] | None = None


def slot_key(slot: Slot, epoch: jax.Array | int, purpose: int) -> Key:
    """The key of a slot for one epoch and purpose."""
    return jax.random.fold_in(jax.random.fold_in(slot.key, epoch), purpose)


def require_length(env: Env, config: TrainConfig) -> None:
    """Refuse an environment whose episodes are not as long as the configuration's.

    An epoch steps through the configuration's episode, and sums of an episode are
    scaled by the environment's: two lengths would scale every cost and return.

    Raises:
      ValueError: naming both lengths.
    """
    length, wanted = env.episode_length, config.env.num_steps
    if length != wanted:
        raise ValueError(
            f"the environment has episodes of {length} steps, the configuration of "
            f"{wanted} (num_steps): make the environment from the configuration, "
            "make_env(config.env), or set num_steps"
        )


def init_learner(agent: Agent, slot: Slot) -> Learner:
    """A fresh learner for one slot; vmap it for a group."""
    return Learner(
        agent=agent.init(slot_key(slot, 0, INIT)),
        frozen=jnp.zeros((), bool),
        frozen_epoch=jnp.full((), -1, jnp.int32),
    )


def run_epoch(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    state: EpochState,
    slots: tuple[Slot, ...],
    epoch: jax.Array,
    bank: Sequence[CostTerm] = BANK,
) -> tuple[EpochState, tuple[Metrics, ...]]:
    """One epoch of every slot of every group.

    Args:
      env: the environment all slots share.
      agents: one algorithm for each group.
      config: sizes of the epoch.
      state: from `start_epochs` or the epoch before.
      slots: for each group, stacked [P_g, ...].
      epoch: [] int32, counted from the start of the stage.
      bank: the cost terms, static.

    Returns:
      The next state, and for each group metrics [P_g].
    """
    worlds, seen = _rollout(env, agents, config, state, slots, epoch)
    learners, metrics = [], []
    for agent, learner, slot, (trajectory, counts) in zip(
        agents, state.learners, slots, seen, strict=True
    ):

        def update(learner: Learner, slot: Slot, trajectory, counts, agent=agent):
            return _update(
                env, agent, config, learner, slot, trajectory, counts, epoch, bank
            )

        inputs = (learner, slot, trajectory, counts)
        learned, group_metrics = _map_slots(config, update, inputs)
        learners.append(learned)
        metrics.append(group_metrics)
    carried = _carry(config, slots, worlds)
    return EpochState(tuple(learners), carried), tuple(metrics)


def start_epochs(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    learners: tuple[Learner, ...],
    slots: tuple[Slot, ...],
) -> EpochState:
    """The state before the first epoch: learners, and the cohorts that a stage has.

    Cohort j has stepped j / k of an episode with the initial policies; what they saw
    is discarded. With one segment per episode there is none.
    """
    segments = config.segments_per_episode
    if segments == 1:
        return EpochState(learners)
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *slots)
    num_carried = config.num_worlds * (segments - 1)
    before = jnp.asarray(-segments, jnp.int32)  # no other epoch has this number
    worlds = jax.vmap(
        lambda slot: reset_worlds(env, slot_key(slot, before, RESET), num_carried)
    )(joined)
    first = EpochState(learners, _carry(config, slots, worlds))

    def warm_up(state: EpochState, segment: jax.Array):
        # Negative epochs: their keys are not those of any training epoch.
        worlds, _ = _rollout(env, agents, config, state, slots, -1 - segment)
        return EpochState(learners, _carry(config, slots, worlds)), None

    return jax.lax.scan(warm_up, first, jnp.arange(segments - 1))[0]


def final_episodes(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    learners: tuple[Learner, ...],
    slots: tuple[Slot, ...],
    num_rounds: int,
) -> tuple[Metrics, ...]:
    """What trained agents do in whole fresh episodes, with sampled actions.

    With cohorts an epoch's episodes were begun by older policies; these were not. A
    round is one episode of all k N worlds of a slot.

    Returns:
      For each group metrics [num_rounds, P_g]: `episode_metrics`, `cost_by_distance`,
      and the environment's counters.
    """
    whole = dataclasses.replace(
        config,
        num_worlds=config.num_worlds * config.segments_per_episode,
        segments_per_episode=1,
    )
    state = EpochState(learners)

    def play(carry: None, index: jax.Array):
        epoch = config.num_epochs + index  # no epoch has this number
        _, seen = _rollout(env, agents, whole, state, slots, epoch)

        def one(slot: Slot, trajectory: Trajectory, counts: Metrics) -> Metrics:
            cost = trajectory.cost_inputs.cost
            metrics = episode_metrics(trajectory, cost, env.episode_length)
            metrics |= cost_by_distance(trajectory, slot.cost.theta)
            return metrics | {name: jnp.mean(x) for name, x in counts.items()}

        return carry, tuple(
            jax.vmap(one)(slot, *group) for slot, group in zip(slots, seen, strict=True)
        )

    return jax.lax.scan(play, None, jnp.arange(num_rounds, dtype=jnp.int32))[1]


def train(
    env: Env,
    agent: Agent,
    slot: Slot,
    config: TrainConfig,
    bank: Sequence[CostTerm] = BANK,
) -> tuple[Any, Metrics]:
    """Train one slot for `config.num_epochs` epochs; jit and vmap it as you like.

    Args:
      env: the environment.
      agent: `ppo_lagrangian(...)`, `cpo(...)` or your own.
      slot: the slot's cost, key and switch.
      config: sizes.
      bank: the cost terms that `slot.cost.weights` weighs.

    Returns:
      The agent's state and metrics [num_epochs].

    Raises:
      ValueError: if the environment's episodes have another length than `config`'s.
    """
    slots = jax.tree.map(lambda x: x[None], slot)
    learners = jax.vmap(lambda slot: init_learner(agent, slot))(slots)
    learners, metrics = run_stage(env, (agent,), config, (learners,), (slots,), bank)
    first = jax.tree.map(lambda x: x[0], learners[0].agent)
    return first, {name: value[:, 0] for name, value in metrics[0].items()}


def run_stage(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    learners: tuple[Learner, ...],
    slots: tuple[Slot, ...],
    bank: Sequence[CostTerm] = BANK,
) -> tuple[tuple[Learner, ...], tuple[Metrics, ...]]:
    """`config.num_epochs` epochs of fresh learners as one traceable function.

    Returns:
      Learners and for each group metrics [num_epochs, P_g].
    """

    def body(state: EpochState, epoch: jax.Array):
        return run_epoch(env, agents, config, state, slots, epoch, bank)

    state = start_epochs(env, agents, config, learners, slots)
    epochs = jnp.arange(config.num_epochs, dtype=jnp.int32)
    state, metrics = jax.lax.scan(body, state, epochs)
    return state.learners, metrics


def _carry(
    config: TrainConfig, slots: tuple[Slot, ...], worlds: EnvState
) -> tuple[EnvState, ...] | None:
    """Of [sum P_g, k N] worlds all cohorts but the oldest, a group each."""
    kept = carry_cohorts(worlds, config.num_worlds, config.segments_per_episode, 1)
    if kept is None:
        return None
    return tuple(jax.tree.map(lambda x, p=p: x[p], kept) for p in _parts(slots))


def population_chunk(config: TrainConfig, num_slots: int) -> int:
    """How many of a device's slots of one algorithm learn side by side.

    Unless the configuration says: on a CPU one after the other, whose arrays then stay
    in a core's cache and which stops early by itself; all on other devices.
    """
    default = 1 if jax.default_backend() == "cpu" else num_slots
    return min(config.population_chunk or default, num_slots)


def _map_slots(config: TrainConfig, function: Callable[..., Any], inputs: Any) -> Any:
    """`function` of each slot of inputs [P, ...], `population_chunk` side by side."""
    num_slots = jax.tree.leaves(inputs)[0].shape[0]
    chunk = population_chunk(config, num_slots)
    if chunk == 1:  # without the axis of length 1 that `batch_size` would carry along
        return jax.lax.map(lambda slot: function(*slot), inputs)
    if chunk == num_slots:
        return jax.vmap(function)(*inputs)
    return jax.lax.map(lambda slot: function(*slot), inputs, batch_size=chunk)


def _parts(slots: tuple[Slot, ...]) -> list[slice]:
    """Where each group lies on the joined slot axis."""
    parts, start = [], 0
    for slot in slots:
        parts.append(slice(start, start + slot.key.shape[0]))
        start = parts[-1].stop
    return parts


def _rollout(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    state: EpochState,
    slots: tuple[Slot, ...],
    epoch: jax.Array,
) -> tuple[EnvState, list[tuple[Trajectory, Metrics]]]:
    """All slots of all groups in one batch of worlds [sum P_g, k N, ...].

    Returns the worlds after the epoch, and for each group what its slots saw: the
    trajectories [P_g, T, k N, ...] and the environment's counters [P_g, k N], float32.
    """
    require_length(env, config)

    def keys(purpose: int) -> list[Key]:
        return [jax.vmap(lambda slot: slot_key(slot, epoch, purpose))(s) for s in slots]

    fresh = jax.vmap(lambda key: reset_worlds(env, key, config.num_worlds))(
        jnp.concatenate(keys(RESET))
    )
    older = None
    if state.worlds is not None:
        older = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *state.worlds)
    start = join_cohorts(fresh, older, 1)
    act_keys, parts = keys(ACT), _parts(slots)

    def act(obs: jax.Array, t: jax.Array) -> jax.Array:
        actions = []
        for agent, learner, key, part in zip(
            agents, state.learners, act_keys, parts, strict=True
        ):
            actions.append(
                jax.vmap(
                    lambda state, obs, key, agent=agent: agent.policy(
                        state, obs, jax.random.fold_in(key, t)
                    )
                )(learner.agent, obs[part], key)
            )
        return jnp.concatenate(actions)

    step = jax.vmap(jax.vmap(env.step))
    worlds, trajectory = unroll_batch(step, act, start, config.epoch_steps)
    counters = jax.tree.map(
        lambda after, before: (after - before).astype(jnp.float32),
        worlds.metrics,
        start.metrics,
    )
    slot_first = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), trajectory)
    seen = [
        jax.tree.map(lambda x, part=part: x[part], (slot_first, counters))
        for part in parts
    ]
    return worlds, seen


def _update(
    env: Env,
    agent: Agent,
    config: TrainConfig,
    learner: Learner,
    slot: Slot,
    trajectory: Trajectory,
    counts: Metrics,
    epoch: jax.Array,
    bank: Sequence[CostTerm],
) -> tuple[Learner, Metrics]:
    """Learn from one slot's trajectory, or freeze at the last finite state."""
    valid = trajectory.valid
    total = total_cost(slot.cost, trajectory.cost_inputs, bank)
    total = jnp.where(valid > 0, total, 0.0)
    updated, metrics = agent.update(
        learner.agent, trajectory, total, slot, slot_key(slot, epoch, UPDATE)
    )
    metrics = metrics | episode_metrics(trajectory, total, env.episode_length)
    episodes = 1.0 / config.segments_per_episode  # share of an episode in an epoch
    for name, value in counts.items():
        metrics[name] = jnp.mean(value) / episodes
    healthy = _all_finite((updated, metrics)) & (jnp.sum(valid) > 0)
    frozen = learner.frozen | ~healthy
    first = frozen & ~learner.frozen
    metrics["frozen"] = frozen.astype(jnp.float32)
    metrics |= cost_by_distance(trajectory, slot.cost.theta)
    return Learner(
        agent=jax.tree.map(
            lambda old, new: jnp.where(frozen, old, new), learner.agent, updated
        ),
        frozen=frozen,
        frozen_epoch=jnp.where(first, epoch, learner.frozen_epoch),
    ), metrics


def _all_finite(tree: Any) -> jax.Array:
    """One check of all numbers together; one of each leaf is far more to compile."""
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree)]
    floats = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.all(jnp.isfinite(jnp.concatenate(floats)))
