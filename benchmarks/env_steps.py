"""How fast each of the twelve worlds steps, and how long it compiles.

    python benchmarks/env_steps.py                     # all, batch 1024
    python benchmarks/env_steps.py --only Goal-Hazard-Car --batch 128

A step is everything a learner gets: physics, sensors, lidars, reward, cost, goal moves,
and a thousandth of a reset. Actions are uniform; the batch is dealt to one JAX device a
core. Steady state is the best of three runs, apart from the compile. Writes
benchmarks/results/env_steps.json; `--only` renews some of its rows.
"""

import argparse
import functools
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from autocost_jax import list_envs, make_env
from autocost_jax.commandline import use_devices
from autocost_jax.envs.env import Env
from autocost_jax.records import EnvState
from autocost_jax.store import run_facts

RESULT = Path(__file__).parent / "results" / "env_steps.json"
REPEATS = 3
STEPS = {"Point": 50, "Car": 10, "Doggo": 5}  # of each world in a timed call
# Env steps a second of one Safety-Gymnasium 1.0.0 process, without its resets, on two
# such cores; measured once, apart from this script, which cannot install it.
PEERS = {
    "Goal-Point": ("PointGoal1", 1375),
    "Goal-Car": ("CarGoal1", 779),
    "Goal-Doggo": ("DoggoGoal1", 544),
    "Push-Point": ("PointPush1", 833),
}


def rollout(env: Env, num_steps: int, worlds: EnvState, key: jax.Array) -> EnvState:
    """`num_steps` steps of uniform actions in a batch of worlds."""
    shape = (worlds.reward.shape[0], env.action_size)

    def step(worlds: EnvState, t: jax.Array) -> tuple[EnvState, None]:
        key_t = jax.random.fold_in(key[0], t)
        action = jax.random.uniform(key_t, shape, minval=-1.0, maxval=1.0)
        return jax.vmap(env.step)(worlds, action), None

    return jax.lax.scan(step, worlds, jnp.arange(num_steps))[0]


def timed(function: Any, *inputs: Any) -> tuple[float, Any]:
    """Shortest of `REPEATS` calls in seconds, and the last output."""
    best, output = float("inf"), None
    for _ in range(REPEATS):
        start = time.perf_counter()
        output = jax.block_until_ready(function(*inputs))
        best = min(best, time.perf_counter() - start)
    return best, output


def measure(name: str, batch: int, devices: Sequence[Any]) -> dict[str, Any]:
    """One row: compile seconds and env steps a second of a world."""
    env = make_env(name)
    robot = env.config.robot
    mesh = Mesh(devices, ("world",))
    split = PartitionSpec("world")
    shard = functools.partial(
        jax.shard_map, mesh=mesh, in_specs=split, out_specs=split, check_vma=False
    )
    keys = jax.random.split(jax.random.key(0), batch)
    reset = jax.jit(shard(jax.vmap(env.reset)))
    worlds = jax.block_until_ready(reset(keys))
    reset_seconds, worlds = timed(reset, keys)

    roll = functools.partial(rollout, env, STEPS[robot])
    program = jax.jit(
        jax.shard_map(
            roll,
            mesh=mesh,
            in_specs=(split, split),
            out_specs=split,
            check_vma=False,
        )
    )
    device_keys = jax.random.split(jax.random.key(1), len(devices))
    start = time.perf_counter()
    compiled = program.lower(worlds, device_keys).compile()
    compile_seconds = time.perf_counter() - start
    worlds = compiled(worlds, device_keys)  # warm up
    seconds, worlds = timed(compiled, worlds, device_keys)
    step_seconds = seconds / (batch * STEPS[robot])
    step_seconds += reset_seconds / batch / env.episode_length
    row: dict[str, Any] = {
        "env": name,
        "batch": batch,
        "compile_seconds": round(compile_seconds, 1),
        "env_steps_per_second": round(1 / step_seconds),
        "failed_worlds": int(worlds.failed.sum()),
    }
    peer = PEERS.get(f"{env.config.task}-{robot}")
    if peer is not None:
        row["peer"], rate = peer
        row["ratio"] = round(1 / step_seconds / rate, 1)
    return row


def main() -> None:
    """Measure, print a table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=list_envs(), default=list_envs())
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    devices = use_devices(None)
    old = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    rows = {row["env"]: row for row in old}
    for name in options.only:
        rows[name] = measure(name, options.batch, devices)
        print(json.dumps(rows[name]), flush=True)
        facts = run_facts()
        facts.pop("seed")
        result = {
            "command": "python benchmarks/env_steps.py",
            "facts": facts,
            "devices": len(devices),
            "peer": "one Safety-Gymnasium 1.0.0 process, resets not counted",
            "rows": [rows[env] for env in list_envs() if env in rows],
        }
        options.out.parent.mkdir(exist_ok=True)
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
