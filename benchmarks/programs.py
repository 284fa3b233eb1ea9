"""How a program of slots compiles, spreads over devices, and uses them.

What `population.py` measures beside the package's own `autocost_jax.bench`.
"""

import dataclasses
import functools
import tempfile
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import Mesh, PartitionSpec

from autocost_jax.bench import (
    Speed,
    algorithm_speeds,
    extrinsic_slots,
    idle,
    program_speed,
    timed,
    update_flop,
)
from autocost_jax.config import Algorithm, SearchConfig, TrainConfig
from autocost_jax.envs.env import make_env
from autocost_jax.population import make_agents, make_population


class CompileTimes(NamedTuple):
    """Seconds until a search's program is compiled.

    Attributes:
      env: name of the world.
      physics: `EnvConfig.physics`.
      cold: traced and compiled.
      warm: traced, and read from the compile cache.
    """

    env: str
    physics: str
    cold: float
    warm: float


class UpdateSpeed(NamedTuple):
    """How near an update comes to the device's own matrix products.

    Attributes:
      algorithm: whose update.
      slots: that learn in the program.
      rows: of a slot's batch.
      precision: `AgentConfig.critic_precision`.
      seconds: of the update of all slots.
      tera_flop: of all slots' matrix products, by `update_flop`.
      tera_flop_per_second: the update's rate.
      matmul_tera_flop_per_second: of a chain of square products of the hidden width,
        on the same devices.
      share: of the two rates.
    """

    algorithm: str
    slots: int
    rows: int
    precision: str
    seconds: float
    tera_flop: float
    tera_flop_per_second: float
    matmul_tera_flop_per_second: float
    share: float


def compile_times(config: SearchConfig, devices: Sequence[Any]) -> CompileTimes:
    """Seconds to compile a search's program without and with a compile cache."""
    train = config.train
    env = make_env(train.env)
    agents = make_agents(config.algorithms, train, env)
    slots = tuple(extrinsic_slots(config.population_size) for _ in agents)
    before = getattr(jax.config, "jax_compilation_cache_dir", None)
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        try:
            jax.config.update("jax_compilation_cache_dir", folder)
            for _ in range(2):
                compilation_cache.reset_cache()
                jax.clear_caches()
                population = make_population(env, agents, train, devices=devices)
                state = population.init(slots)
                start = time.perf_counter()
                population.compile(state, slots)
                seconds.append(round(time.perf_counter() - start, 1))
        finally:
            jax.config.update("jax_compilation_cache_dir", before)
            compilation_cache.reset_cache()
    return CompileTimes(train.env.name, train.env.physics, *seconds)


def device_speeds(
    train: TrainConfig, algorithm: Algorithm, size: int, devices: Sequence[Any]
) -> list[Speed]:
    """One program of `size` slots on 1, 2, 4, 8 ... of the devices."""
    counts = [2**power for power in range(len(devices).bit_length())]
    programs = [
        (size, devices[:count], f"{size} slots, {count} devices") for count in counts
    ]
    return algorithm_speeds(train, algorithm, programs)


def update_speed(
    train: TrainConfig, algorithm: Algorithm, size: int, devices: Sequence[Any]
) -> UpdateSpeed:
    """Seconds of `size` slots' updates, against the devices' matrix products.

    The difference of a program with updates and one without. PPO's stop on the KL is
    off, so that all passes are made.
    """
    agent = dataclasses.replace(train.agent, kl_stop_factor=1e9)
    train = dataclasses.replace(train, agent=agent, chunk_epochs=1)
    env = make_env(train.env)
    learner = make_agents((algorithm,), train, env)[0]
    seconds = []
    for kind in (learner, idle(learner)):
        population = make_population(env, (kind,), train, devices=devices)
        speed = program_speed(train, population, (extrinsic_slots(size),), algorithm)
        steps = speed.worlds * train.epoch_steps
        seconds.append(steps / speed.env_steps_per_second)
    spent = seconds[0] - seconds[1]
    flop = size * update_flop(train, algorithm, env)
    peak = matmul_rate(max(agent.hidden_sizes), devices)
    return UpdateSpeed(
        algorithm=algorithm,
        slots=size,
        rows=train.num_worlds * train.env.num_steps,
        precision=agent.critic_precision,
        seconds=round(spent, 3),
        tera_flop=round(flop / 1e12, 4),
        tera_flop_per_second=round(flop / spent / 1e12, 4),
        matmul_tera_flop_per_second=round(peak / 1e12, 4),
        share=round(flop / spent / peak, 3),
    )


def matmul_rate(width: int, devices: Sequence[Any]) -> float:
    """Operations a second of square float32 products, on all devices together."""
    rows, count = 4096, 50
    mesh, split = Mesh(devices, ("row",)), PartitionSpec("row")

    @functools.partial(
        jax.shard_map, mesh=mesh, in_specs=split, out_specs=split, check_vma=False
    )
    def chain(x: jax.Array) -> jax.Array:
        square = jnp.full((width, width), 1.0 / width, x.dtype)
        with jax.default_matmul_precision("highest"):
            return jax.lax.fori_loop(0, count, lambda _, x: x @ square, x)

    x = jnp.ones((rows * len(devices), width), jnp.float32)
    program = jax.jit(chain)
    timed(program, x)  # compiles and warms up
    seconds, _ = timed(program, x)
    return count * 2 * x.shape[0] * width**2 / seconds
