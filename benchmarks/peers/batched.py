"""Timing of a JAX environment of another project, as `autocost_jax.bench` times ours.

Only JAX is imported: this runs in the peers' own virtual environments.
"""

import json
import time

import jax


def measure(reset, step, action_size, batch, num_steps):
    """Print the compile time and the best steady rate of three calls."""

    def steps(state, key):
        def one(state, key):
            action = jax.random.uniform(
                key, (batch, action_size), minval=-1.0, maxval=1.0
            )
            return jax.vmap(step)(state, action), None

        return jax.lax.scan(one, state, jax.random.split(key, num_steps))[0]

    keys = jax.random.split(jax.random.PRNGKey(0), batch)
    state = jax.block_until_ready(jax.jit(jax.vmap(reset))(keys))
    program = jax.jit(steps)
    key = jax.random.PRNGKey(1)
    start = time.perf_counter()
    compiled = program.lower(state, key).compile()
    compile_seconds = time.perf_counter() - start
    best = float("inf")
    for repeat in range(4):  # the first warms up
        start = time.perf_counter()
        state = jax.block_until_ready(compiled(state, key))
        if repeat:
            best = min(best, time.perf_counter() - start)
    rate = round(batch * num_steps / best)
    print(
        json.dumps(
            {
                "env_steps_per_second": rate,
                "compile_seconds": round(compile_seconds, 1),
            }
        )
    )
