"""The population program: every slot of every algorithm in one jitted chunk.

The chunk is K epochs of the whole population under `jax.shard_map`: each device holds
its share of every group and trains it without talking to the others. Groups are padded
with copies of their first slot to a multiple of the device count. One code path serves
one device and many. Programs are compiled here, in `evaluate` and in `bench` alone.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from autocost_jax.agents.base import Agent
from autocost_jax.agents.cpo import cpo
from autocost_jax.agents.focops import focops
from autocost_jax.agents.pid_lagrangian import pid_lagrangian
from autocost_jax.agents.ppo_lagrangian import ppo_lagrangian
from autocost_jax.config import Algorithm, TrainConfig
from autocost_jax.costs import BANK, CostTerm
from autocost_jax.envs.env import Env
from autocost_jax.evaluate import Episodes, run_episodes, score
from autocost_jax.files import is_key
from autocost_jax.records import EvalResult, Key, Metrics, Slot, TrainingCost
from autocost_jax.train import (
    EpochState,
    final_episodes,
    init_learner,
    require_length,
    run_epoch,
    start_epochs,
)

AXIS = "slot"
# It runs once a stage: compiling it took 11 s at level 3 and 2 s at level 1.
INIT_OPTIONS = {"xla_backend_optimization_level": 1}
AGENTS: dict[Algorithm, Callable[..., Agent]] = {
    "ppo_lagrangian": ppo_lagrangian,
    "cpo": cpo,
    "focops": focops,
    "pid_lagrangian": pid_lagrangian,
}


class Population(NamedTuple):
    """The compiled face of a population.

    Attributes:
      init: slots, one stacked pytree [P_g, ...] a group -> state before any epoch.
      final: (state, slots) -> what trained agents do in whole fresh episodes, metrics
        [rounds, P_g] a group.
      chunk: (state, slots, epoch) -> (state, metrics [K, P_g] a group); the state
        passed in is donated.
      compile: (state, slots) -> the program of `chunk` for these shapes, compiled
        ahead of its first call; `chunk` compiles any other shapes when they come.
      fetch: stacked pytree -> the same in the memory of every process.
      num_devices: devices it runs on.
    """

    init: Callable[[tuple[Slot, ...]], EpochState]
    final: Callable[[EpochState, tuple[Slot, ...]], tuple[Metrics, ...]]
    chunk: Callable[..., tuple[EpochState, tuple[Metrics, ...]]]
    compile: Callable[[EpochState, tuple[Slot, ...]], Any]
    fetch: Callable[[Any], Any]
    num_devices: int


def make_agents(
    algorithms: Sequence[Algorithm], config: TrainConfig, env: Env
) -> tuple[Agent, ...]:
    """One Agent for each named algorithm."""
    return tuple(AGENTS[name](config.agent, env) for name in algorithms)


def stack_slots(slots: Sequence[Slot]) -> Slot:
    """Slots as one stacked pytree [P, ...]."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *slots)


def candidate_slots(cost: TrainingCost, key: Key, constrained: float = 1.0) -> Slot:
    """Slots [P] of stacked costs [P, ...] that share one key.

    Common random numbers: all candidates of a stage meet the same layouts.
    """
    size = cost.limit.shape[0]
    return Slot(
        cost=cost,
        key=jnp.broadcast_to(key, (size,)),
        constrained=jnp.full((size,), constrained, jnp.float32),
    )


def jit_bundle(bundle: Any) -> Any:
    """A NamedTuple of pure functions with each of them jitted."""
    return type(bundle)(*(jax.jit(fn) for fn in bundle))


def run_compiled(function: Callable[..., Any], *args: Any, **settings: Any) -> Any:
    """`function(*args, **settings)` as one program, not one for each operation.

    Args:
      function: pure.
      args: arrays.
      settings: hashable; they shape the program.
    """
    return _program(function, tuple(settings.items()))(*args)


@functools.cache
def _program(function: Callable[..., Any], settings: tuple[Any, ...]) -> Any:
    return jax.jit(functools.partial(function, **dict(settings)))


def make_population(
    env: Env,
    agents: Sequence[Agent],
    config: TrainConfig,
    bank: Sequence[CostTerm] = BANK,
    devices: Sequence[Any] | None = None,
    final_rounds: int = 1,
) -> Population:
    """The program that trains groups of slots, one group for each agent.

    Args:
      env: the environment all slots share.
      agents: one algorithm for each group.
      config: sizes.
      bank: the cost terms.
      devices: default: the first device only.
      final_rounds: of `final`.

    Raises:
      ValueError: if the environment's episodes have another length than `config`'s.
    """
    require_length(env, config)
    agents, bank = tuple(agents), tuple(bank)
    mesh = Mesh(np.asarray(devices or jax.devices()[:1]), (AXIS,))
    chunk_fn = _chunk_fn(env, agents, config, bank, mesh)
    is_short = config.segments_per_episode == 1  # else it steps worlds, too
    is_cpu = mesh.devices.flat[0].platform == "cpu"
    init_fn = jax.jit(
        _sharded(lambda slots: _init(env, agents, config, slots), mesh, P(AXIS)),
        compiler_options=INIT_OPTIONS if is_cpu and is_short else {},
    )
    final_fn = jax.jit(
        jax.shard_map(
            lambda state, slots: final_episodes(
                env, agents, config, state.learners, slots, final_rounds
            ),
            mesh=mesh,
            in_specs=P(AXIS),
            out_specs=P(None, AXIS),
            check_vma=False,
        )
    )
    compiled: dict[Any, Any] = {}  # by the shapes that it is for

    def init(slots: tuple[Slot, ...]) -> EpochState:
        return _unpad(init_fn(_pad(slots, mesh)), _sizes(slots))

    def compile_(state: EpochState, slots: tuple[Slot, ...]):
        inputs = _pad((state, slots), mesh)
        program = chunk_fn.lower(*inputs, jnp.zeros((), jnp.int32)).compile()
        compiled[_shapes(inputs)] = program
        return program

    def chunk(state: EpochState, slots: tuple[Slot, ...], epoch: int):
        inputs, sizes = _pad((state, slots), mesh), _sizes(slots)
        run = compiled.get(_shapes(inputs), chunk_fn)
        state, metrics = run(*inputs, jnp.asarray(epoch, jnp.int32))
        return _unpad(state, sizes), _unpad_metrics(metrics, sizes)

    def final(state: EpochState, slots: tuple[Slot, ...]):
        metrics = final_fn(*_pad((state, slots), mesh))
        return _unpad_metrics(metrics, _sizes(slots))

    return Population(
        init, final, chunk, compile_, lambda tree: _fetch(tree, mesh), mesh.size
    )


def make_evaluator(
    env: Env,
    agent: Agent,
    num_episodes: int,
    deterministic: bool = False,
    keep: Callable[[Episodes], Any] = lambda episodes: (),
    **options: Any,
) -> Callable[[Any, Key], tuple[EvalResult, Any]]:
    """Evaluate stacked policies in one compiled call.

    All policies meet the same layouts. `agent` may be any algorithm whose `policy`
    understands the states: PPO-Lagrangian's acts for CPO's, too.

    Args:
      env: the environment.
      agent: whose policies they are.
      num_episodes: E, of each policy.
      deterministic: act by the mean instead of sampling.
      keep: what to keep of a policy's episodes beside their scores; all of them fill a
        memory soon.
      options: of `run_episodes`.

    Returns:
      (agent states [P, ...], key) -> EvalResult [P, E] and what was kept [P, ...].
    """

    def evaluate_one(state: Any, key: Key) -> tuple[EvalResult, Any]:
        episodes = run_episodes(
            env, agent, state, key, num_episodes, deterministic, **options
        )
        return score(episodes), keep(episodes)

    return jax.jit(jax.vmap(evaluate_one, in_axes=(0, None)))


def _init(
    env: Env, agents: tuple[Agent, ...], config: TrainConfig, slots: tuple[Slot, ...]
) -> EpochState:
    learners = tuple(
        jax.vmap(lambda slot, agent=agent: init_learner(agent, slot))(group)
        for agent, group in zip(agents, slots, strict=True)
    )
    return start_epochs(env, agents, config, learners, slots)


def _chunk_fn(
    env: Env,
    agents: tuple[Agent, ...],
    config: TrainConfig,
    bank: tuple[CostTerm, ...],
    mesh: Mesh,
):
    def chunk(state: EpochState, slots: tuple[Slot, ...], epoch: jax.Array):
        def body(state: EpochState, epoch: jax.Array):
            return run_epoch(env, agents, config, state, slots, epoch, bank)

        epochs = epoch + jnp.arange(config.chunk_epochs, dtype=jnp.int32)
        return jax.lax.scan(body, remake_empty(state), epochs)

    sharded = jax.shard_map(
        chunk,
        mesh=mesh,
        in_specs=(P(AXIS), P(AXIS), P()),
        out_specs=(P(AXIS), P(None, AXIS)),
        check_vma=False,
    )
    return jax.jit(sharded, donate_argnums=0)


def remake_empty(tree: Any) -> Any:
    """The same tree with new arrays for those without elements, such as no pillars.

    jaxlib 0.11 crashes when it compiles a program for several CPU devices that returns
    an empty array it was given.
    """
    return jax.tree.map(lambda x: x if x.size else jnp.zeros_like(x), tree)


def _sharded(fn: Callable, mesh: Mesh, spec: P) -> Callable:
    return jax.shard_map(fn, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)


def _sizes(groups: tuple[Slot, ...]) -> list[int]:
    return [group.key.shape[0] for group in groups]


def _shapes(tree: Any) -> Any:
    """What a compiled program demands of its inputs, to look it up by."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def _pad(tree: Any, mesh: Mesh) -> Any:
    """Each group filled up with copies of its first slot, laid over the devices."""
    split = NamedSharding(mesh, P(AXIS))

    def pad(leaf: jax.Array) -> jax.Array:
        if split.is_fully_addressable:
            return jax.device_put(_fill(leaf, mesh.size), split)
        if not leaf.is_fully_addressable:  # from an earlier call of the program
            fill = jax.jit(_fill, static_argnums=1, out_shardings=split)
            return fill(leaf, mesh.size)
        if is_key(leaf):
            data = pad(jax.random.key_data(leaf))
            return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
        value = np.asarray(_fill(leaf, mesh.size))  # alike in every process
        return jax.make_array_from_callback(
            value.shape, split, lambda index: value[index]
        )

    return jax.tree.map(pad, tree)


def _fill(leaf: jax.Array, multiple: int) -> jax.Array:
    """A leaf [P, ...] with copies of its first row, up to a multiple of rows."""
    missing = -leaf.shape[0] % multiple
    if not missing:
        return leaf
    filler = jnp.broadcast_to(leaf[:1], (missing, *leaf.shape[1:]))
    return jnp.concatenate([leaf, filler])


def _same(tree: Any) -> Any:
    return tree


def _unpad(state: EpochState, sizes: list[int]) -> EpochState:
    def cut(groups: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(
            jax.tree.map(lambda x, size=size: x[:size] if len(x) > size else x, group)
            for group, size in zip(groups, sizes, strict=True)
        )

    worlds = None if state.worlds is None else cut(state.worlds)
    return EpochState(cut(state.learners), worlds)


def _fetch(tree: Any, mesh: Mesh) -> Any:
    """A tree as it is, where one process sees all devices; else copied to the host."""
    everywhere = NamedSharding(mesh, P())
    if everywhere.is_fully_addressable:
        return tree
    data = jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)
    # One function for all calls, so that each shape is compiled once.
    data = jax.jit(_same, out_shardings=everywhere)(data)

    def take(value: jax.Array, like: jax.Array) -> Any:
        host = np.asarray(value)
        if not is_key(like):
            return host
        return jax.random.wrap_key_data(
            jnp.asarray(host), impl=jax.random.key_impl(like)
        )

    return jax.tree.map(take, data, tree)


def _unpad_metrics(
    metrics: tuple[Metrics, ...], sizes: list[int]
) -> tuple[Metrics, ...]:
    """Metrics [K, P_g] without those of copies."""
    return tuple(
        {name: value[:, :size] for name, value in group.items()}
        for group, size in zip(metrics, sizes, strict=True)
    )
