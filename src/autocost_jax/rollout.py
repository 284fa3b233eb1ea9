"""Rollouts: fresh worlds, a scan of policy and step, and cohorts of worlds.

With `segments_per_episode` = k an epoch is 1/k of an episode long and a slot has k
cohorts of N worlds, each 1/k of an episode older than the one before it. At an epoch's
start one cohort is fresh and the k - 1 carried ones continue; at its end the oldest
has just finished. No step ever pays for a reset. k = 1 carries nothing.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from autocost_jax.envs.env import Env
from autocost_jax.records import EnvState, Key, Trajectory


def reset_worlds(env: Env, key: Key, num_worlds: int) -> EnvState:
    """Worlds with fresh random layouts, fields [N, ...]; the key is consumed."""
    return jax.vmap(env.reset)(jax.random.split(key, num_worlds))


def typical_lidars(env: Env, key: Key, num_places: int = 1024) -> jax.Array:
    """Constraint lidars [M, 8] at uniform places of fresh layouts; key is consumed."""
    key_layout, key_place = jax.random.split(key)
    keys = jax.random.split(key_layout, num_places)
    low_x, low_y, high_x, high_y = env.config.placements_extents

    def look(key: Key, place: jax.Array) -> jax.Array:
        key_reset, key_state = jax.random.split(key)
        layout = env.reset(key_reset).layout.replace(robot_xy=place)
        return env.reset_to(layout, key_state).cost_inputs.constraint_lidar

    low, high = jnp.array([low_x, low_y]), jnp.array([high_x, high_y])
    places = jax.random.uniform(key_place, (num_places, 2), minval=low, maxval=high)
    return jax.vmap(look)(keys, places)


def unroll(
    env: Env,
    policy: Callable[[jax.Array, Key], jax.Array],
    worlds: EnvState,
    key: Key,
    num_steps: int,
) -> tuple[EnvState, Trajectory]:
    """Act for `num_steps` steps in N worlds.

    Args:
      env: the environment.
      policy: (obs [N, O], key) -> action [N, U].
      worlds: fields [N, ...].
      key: source of the actions; step t uses fold_in(key, t).
      num_steps: T.

    Returns:
      The worlds after the last step and the Trajectory, fields [T, N, ...] and obs
      [T + 1, N, O].
    """

    def act(obs: jax.Array, t: jax.Array) -> jax.Array:
        return policy(obs, jax.random.fold_in(key, t))

    return unroll_batch(jax.vmap(env.step), act, worlds, num_steps)


def unroll_batch(
    step: Callable[[EnvState, jax.Array], EnvState],
    act: Callable[[jax.Array, jax.Array], jax.Array],
    worlds: EnvState,
    num_steps: int,
) -> tuple[EnvState, Trajectory]:
    """`unroll` for any leading axes [...] that `step` and `act` agree on.

    Args:
      step: (worlds, action [..., U]) -> worlds.
      act: (obs [..., O], t) -> action [..., U].
      worlds: fields [..., ...].
      num_steps: T.

    Returns:
      Worlds, and the Trajectory with fields [T, ...].
    """

    def body(worlds: EnvState, t: jax.Array):
        action = act(worlds.obs, t)
        after = step(worlds, action)
        valid = (~after.failed).astype(after.reward.dtype)
        rows = (worlds.obs, action, after.reward, after.cost_inputs, valid)
        return after, rows

    worlds, rows = jax.lax.scan(body, worlds, jnp.arange(num_steps))
    obs, action, reward, cost_inputs, valid = rows
    obs = jnp.concatenate([obs, worlds.obs[None]])
    return worlds, Trajectory(
        obs=obs, action=action, reward=reward, cost_inputs=cost_inputs, valid=valid
    )


def join_cohorts(fresh: EnvState, carried: EnvState | None, axis: int) -> EnvState:
    """The worlds of an epoch: the fresh cohort in front of the carried ones."""
    if carried is None:
        return fresh
    return jax.tree.map(
        lambda new, old: jnp.concatenate([new, old], axis), fresh, carried
    )


def carry_cohorts(
    worlds: EnvState, num_worlds: int, segments: int, axis: int
) -> EnvState | None:
    """All cohorts but the oldest, a static slice; None for one segment."""
    if segments == 1:
        return None
    kept = num_worlds * (segments - 1)
    return jax.tree.map(lambda x: jax.lax.slice_in_dim(x, 0, kept, axis=axis), worlds)
