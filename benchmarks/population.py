"""How fast a preset's program compiles and runs, with and without updates.

    python benchmarks/population.py --preset laptop

Rollout alone is the same program with agents whose update does nothing. Steady state
is the best of five chunks, apart from the compile, and on the devices that
`autocost_jax.evolve` would use. Writes benchmarks/results/population_PRESET.json.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from autocost_jax import PRESETS, make_env, make_population, preset
from autocost_jax.commandline import use_devices
from autocost_jax.evolution import init_search, make_searcher
from autocost_jax.population import make_agents
from autocost_jax.store import run_facts

REPEATS = 5


def measure(population: Any, slots: Any, steps: int) -> dict[str, float]:
    """Seconds of compiling and of one chunk, and env steps a second."""
    learners = population.init(slots)
    start = time.perf_counter()
    population.compile(learners, slots)
    compile_seconds = time.perf_counter() - start
    best = float("inf")
    for epoch in range(REPEATS + 1):  # the first warms up
        start = time.perf_counter()
        learners, metrics = population.chunk(learners, slots, epoch)
        jax.block_until_ready((learners, metrics))
        if epoch:
            best = min(best, time.perf_counter() - start)
    return {
        "compile_seconds": round(compile_seconds, 2),
        "chunk_seconds": round(best, 3),
        "env_steps_per_second": round(steps / best),
    }


def main() -> None:
    """Measure, print one table, write one JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", choices=PRESETS, default="laptop")
    parser.add_argument("--devices", type=int, default=None)
    options = parser.parse_args()
    devices = use_devices(options.devices)
    config = preset(options.preset)
    train = config.train
    chunk = train.chunk_epochs * train.num_worlds * train.env.num_steps
    steps = chunk * config.population_size * len(config.algorithms)

    start = time.perf_counter()
    searcher = make_searcher(config, devices)
    state = init_search(searcher)
    jax.block_until_ready(state.learners)
    init_seconds = time.perf_counter() - start
    slots = searcher.stage.slots(0, state.candidates)

    env = make_env(train.env)
    agents = make_agents(config.algorithms, train, env)
    still = tuple(
        agent._replace(update=lambda state, *_: (state, {"idle": jnp.zeros(())}))
        for agent in agents
    )
    rows = {
        "with updates": measure(searcher.population, slots, steps),
        "rollout alone": measure(
            make_population(env, still, train, devices=devices), slots, steps
        ),
    }
    result = {
        "command": f"python benchmarks/population.py --preset {options.preset}",
        "facts": run_facts(),
        "init_seconds": round(init_seconds, 2),
        "slots": config.population_size * len(config.algorithms),
        "worlds": config.population_size * len(config.algorithms) * train.num_worlds,
        "rows": rows,
    }
    print(f"{options.preset}: {result['worlds']} worlds on {len(devices)} device(s)")
    print(f"{'':16}{'compile s':>10}{'chunk s':>10}{'env steps/s':>14}")
    for name, row in rows.items():
        print(
            f"{name:16}{row['compile_seconds']:>10.1f}{row['chunk_seconds']:>10.2f}"
            f"{row['env_steps_per_second']:>14,}"
        )
    file = Path("benchmarks/results") / f"population_{options.preset}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
