"""Measuring how fast things are: worlds, programs, one program against many.

Every number is a steady state, the best of a few calls after a warm-up, apart from the
compile, which is timed by itself and cold unless a compile cache is switched on.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from autocost_jax.agents.base import Agent
from autocost_jax.config import Algorithm, EnvConfig, SearchConfig, TrainConfig
from autocost_jax.costs import training_cost
from autocost_jax.envs.env import Env, make_env, make_physics
from autocost_jax.population import (
    Population,
    make_agents,
    make_population,
    remake_empty,
    stack_slots,
)
from autocost_jax.records import EnvState, Slot, root_key

REPEATS = 3
STEPS = {"Point": 50, "Car": 10, "Doggo": 5}  # of each world in a timed call


class Speed(NamedTuple):
    """What was measured of one program.

    Attributes:
      env: name of the world.
      physics: `EnvConfig.physics`.
      what: what ran.
      worlds: side by side, on all devices together.
      compile_seconds: cold.
      env_steps_per_second: in a steady state.
      workspace_bytes: temporary memory of the program on each device.
    """

    env: str
    physics: str
    what: str
    worlds: int
    compile_seconds: float
    env_steps_per_second: int
    workspace_bytes: int


def env_speed(
    config: EnvConfig, batch: int, devices: Sequence[Any], physics_only: bool = False
) -> Speed:
    """How fast worlds step with uniform actions: all that a learner gets.

    A step is physics, sensors, lidars, reward, cost, goal moves and its share of the
    reset that an episode begins with; or physics alone. The batch is dealt to the
    devices.

    Raises:
      RuntimeError: if a world failed.
    """
    env = make_env(config)
    if physics_only:
        control_step = make_physics(config).control_step
        env = dataclasses.replace(
            env,
            step=lambda state, action: state.replace(
                data=control_step(state.data, state.layout, action)
            ),
        )
    mesh, split = Mesh(devices, ("world",)), PartitionSpec("world")
    shard = functools.partial(
        jax.shard_map, mesh=mesh, in_specs=split, out_specs=split, check_vma=False
    )
    num_steps = STEPS[config.robot]
    keys = jax.random.split(root_key(0), batch)
    each = jax.random.split(root_key(1), len(devices))
    reset = jax.jit(shard(jax.vmap(env.reset)))
    worlds = jax.block_until_ready(reset(keys))
    program = jax.jit(shard(functools.partial(_random_steps, env, num_steps)))
    start = time.perf_counter()
    compiled = program.lower((worlds, each)).compile()
    compile_seconds = time.perf_counter() - start
    reset_seconds, worlds = timed(reset, keys)
    worlds, each = compiled((worlds, each))  # warm up
    seconds, (worlds, each) = timed(compiled, (worlds, each))
    if bool(worlds.failed.any()):
        raise RuntimeError(f"a world of {config.name} met a non-finite number")
    per_step = seconds / (batch * num_steps)
    if not physics_only:
        per_step += reset_seconds / (batch * env.episode_length)
    return Speed(
        env=config.name,
        physics=config.physics,
        what="physics alone" if physics_only else "env steps",
        worlds=batch,
        compile_seconds=round(compile_seconds, 1),
        env_steps_per_second=round(1 / per_step),
        workspace_bytes=_workspace(compiled),
    )


def search_speeds(config: SearchConfig, devices: Sequence[Any]) -> list[Speed]:
    """A search's program with updates, and what it is made of.

    Rollout alone is the same program with agents whose update does nothing; env steps
    and physics alone are those of as many worlds.
    """
    size, train = config.population_size, config.train
    env = make_env(train.env)
    agents = make_agents(config.algorithms, train, env)
    slots = tuple(extrinsic_slots(size) for _ in agents)
    runs = (("with updates", agents), ("rollout alone", tuple(map(idle, agents))))
    batch = size * len(agents) * train.num_worlds * train.segments_per_episode
    parts = [env_speed(train.env, batch, devices, only) for only in (False, True)]
    return parts + [
        program_speed(
            train,
            make_population(env, kind, train, devices=devices),
            slots,
            what,
        )
        for what, kind in runs
    ]


def slot_speeds(
    train: TrainConfig,
    algorithm: Algorithm,
    sizes: Sequence[int],
    devices: Sequence[Any],
) -> list[Speed]:
    """Training in programs of different numbers of slots, on at most one device each.

    One slot is what an ordinary run trains; N of them in turn take N times as long.
    """
    programs = [(size, devices[:size], f"{size} slots") for size in sizes]
    return algorithm_speeds(train, algorithm, programs)


def algorithm_speeds(
    train: TrainConfig,
    algorithm: Algorithm,
    programs: Sequence[tuple[int, Sequence[Any], str]],
) -> list[Speed]:
    """Programs of one algorithm: how many slots, on which devices, called what."""
    env = make_env(train.env)
    agents = make_agents((algorithm,), train, env)
    return [
        program_speed(
            train,
            make_population(env, agents, train, devices=devices),
            (extrinsic_slots(size),),
            f"{algorithm}, {what}",
        )
        for size, devices, what in programs
    ]


def update_flop(train: TrainConfig, algorithm: Algorithm, env: Env) -> float:
    """Floating-point operations of the matrix products of one slot's update.

    With W weights, W_0 of them in the first layer, and R rows: a forward pass is
    2 R W, a gradient 2 R (3 W - W_0), a Fisher product 4 R W a direction.
    """
    agent = train.agent
    rows = train.num_worlds * train.env.num_steps
    hidden = (env.observation_size, *agent.hidden_sizes)
    first = hidden[0] * hidden[1] if len(hidden) > 1 else 0

    def weights(outputs: int) -> int:
        return sum(a * b for a, b in itertools.pairwise((*hidden, outputs)))

    policy, critic = weights(env.action_size), weights(1)

    def gradient(count: int) -> int:
        return 2 * rows * (3 * count - first)

    total = 2 * agent.value_passes * gradient(critic)
    if algorithm == "cpo":
        products = agent.cg_iterations + 1
        return total + products * 2 * 4 * rows * policy + 2 * gradient(policy)
    total += agent.policy_passes * gradient(policy)
    if agent.policy_minibatches > 1:  # the whole batch's KL before each pass
        total += agent.policy_passes * 2 * rows * policy
    return total


def idle(agent: Agent) -> Agent:
    """An agent that acts and does not learn."""
    return agent._replace(update=lambda state, *_: (state, {"idle": jnp.zeros(())}))


def program_speed(
    train: TrainConfig, population: Population, slots: tuple[Slot, ...], what: str
) -> Speed:
    """Training by one program, compiled anew; `what` says in words what it runs."""
    state = population.init(slots)
    start = time.perf_counter()
    compiled = population.compile(state, slots)
    compile_seconds = time.perf_counter() - start
    best = float("inf")
    for chunk in range(REPEATS + 1):  # the first warms up
        start = time.perf_counter()
        state, metrics = population.chunk(state, slots, chunk * train.chunk_epochs)
        jax.block_until_ready((state, metrics))
        if chunk:
            best = min(best, time.perf_counter() - start)
    num_slots = sum(group.key.shape[0] for group in slots)
    worlds = num_slots * train.num_worlds * train.segments_per_episode
    steps = worlds * train.epoch_steps * train.chunk_epochs
    return Speed(
        env=train.env.name,
        physics=train.env.physics,
        what=what,
        worlds=worlds,
        compile_seconds=round(compile_seconds, 1),
        env_steps_per_second=round(steps / best),
        workspace_bytes=_workspace(compiled),
    )


def extrinsic_slots(size: int) -> Slot:
    """Slots [size] of the extrinsic cost alone, one seed each."""
    cost = training_cost("extrinsic", limit=0.0)
    ones = jnp.ones((), jnp.float32)
    return stack_slots([Slot(cost, root_key(i), ones) for i in range(size)])


def _random_steps(
    env: Env, num_steps: int, inputs: tuple[EnvState, jax.Array]
) -> tuple[EnvState, jax.Array]:
    """Uniform actions in a batch of worlds; the keys [1] are returned advanced."""
    worlds, keys = remake_empty(inputs)
    shape = (worlds.reward.shape[0], env.action_size)

    def step(worlds: EnvState, t: jax.Array) -> tuple[EnvState, None]:
        key = jax.random.fold_in(keys[0], t)
        action = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
        return jax.vmap(env.step)(worlds, action), None

    worlds, _ = jax.lax.scan(step, worlds, jnp.arange(num_steps))
    return worlds, jax.vmap(lambda key: jax.random.fold_in(key, num_steps))(keys)


def timed(function: Any, *inputs: Any) -> tuple[float, Any]:
    """Shortest of `REPEATS` calls in seconds, and the last output."""
    best, output = float("inf"), None
    for _ in range(REPEATS):
        start = time.perf_counter()
        output = jax.block_until_ready(function(*inputs))
        best = min(best, time.perf_counter() - start)
    return best, output


def _workspace(compiled: Any) -> int:
    """Bytes of temporary memory; -1 where the backend does not tell."""
    analysis = compiled.memory_analysis()
    return -1 if analysis is None else int(analysis.temp_size_in_bytes)


def bench(
    config: SearchConfig,
    envs: Sequence[EnvConfig],
    batch: int,
    devices: Sequence[Any],
) -> Iterator[Speed]:
    """The whole suite, a row as soon as it is measured.

    Args:
      config: of a search; its program is timed, and its agents in programs of 1 and 16
        slots.
      envs: worlds whose steps are timed.
      batch: of them.
      devices: what everything runs on.
    """
    for env in envs:
        yield env_speed(env, batch, devices)
    yield from search_speeds(config, devices)
    for algorithm in config.algorithms:
        yield from slot_speeds(config.train, algorithm, (1, 16), devices)
