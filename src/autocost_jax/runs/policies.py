"""Saved policies: their files, loading them, and their scores for people."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from autocost_jax.agents.base import Actor, Agent, actor
from autocost_jax.config import TrainConfig
from autocost_jax.envs.env import Env
from autocost_jax.files import RunDirError, load_arrays, unflatten
from autocost_jax.population import make_agents
from autocost_jax.records import EvalResult, Key, root_key
from autocost_jax.runs.config_files import read_document

EPISODES = 100  # that score an agent unless told otherwise
EVALUATION = 2**31 - 1  # purpose of the final evaluation's key, beyond any stage


def episodes_of(path: Path, resume: bool, asked: int | None) -> int:
    """Fresh episodes that score an agent: as asked, else as the run began, else 100.

    Raises:
      ValueError: there are none.
      RunDirError: there is no run to resume.
    """
    count = asked
    if count is None and resume:
        count = read_document(path)["facts"].get("num_episodes")
    count = EPISODES if count is None else count
    if not isinstance(count, int) or count < 1:
        raise ValueError(f"number of episodes must be >= 1, got {count}")
    return count


def policy_name(stage: int, algorithm: str) -> str:
    """File stem of the policy of a stage's best candidate."""
    return f"stage_{stage:02d}_{algorithm}"


def load_policies(
    env: Env, train: TrainConfig, files: Sequence[Path]
) -> tuple[Agent, Any]:
    """Saved policies as one stacked agent state, and the agent that acts for it.

    Args:
      env: where they act.
      train: the run's training configuration, for the shapes.
      files: policies/*.npz.

    Returns:
      Agent, and its state with the policies stacked [P, ...].

    Raises:
      RunDirError: a file is missing or is not such a policy.
    """
    part = actor(_shapes(_acting_agent(env, train)))
    loaded = [unflatten(load_arrays(file, None), part) for file in files]
    return policy_states(env, train, jax.tree.map(lambda *x: np.stack(x), *loaded))


def policy_states(env: Env, train: TrainConfig, actors: Actor) -> tuple[Agent, Any]:
    """Actors [P, ...] as one stacked agent state, and the agent that acts for it.

    What does not act is zero.
    """
    agent = _acting_agent(env, train)
    size = jax.tree.leaves(actors)[0].shape[0]
    zeros = jax.tree.map(
        lambda leaf: np.zeros((size, *leaf.shape), leaf.dtype), _shapes(agent)
    )
    return agent, dataclasses.replace(zeros, **actors._asdict())


def _shapes(agent: Agent) -> Any:
    """Of the state of one agent."""
    return jax.eval_shape(agent.init, root_key(0))


def _acting_agent(env: Env, train: TrainConfig) -> Agent:
    """Whose policy it is does not matter: all agents act alike."""
    return make_agents(("ppo_lagrangian",), train, env)[0]


def policy_files(path: Path, names: Sequence[str] = ()) -> list[Path]:
    """The files of a run's policies, all of them by default.

    Raises:
      RunDirError: one does not exist; the message lists those that do.
    """
    known = sorted(file.stem for file in (path / "policies").glob("*.npz"))
    names = list(names) or known
    odd = [name for name in names if name not in known]
    if odd or not names:
        raise RunDirError(
            f"{path} has no policy {odd[0] if odd else ''!r}; "
            f"policies: {', '.join(known) or 'none'}"
        )
    return [path / "policies" / f"{name}.npz" for name in names]


def scripted_agent(name: str, env: Env) -> Agent:
    """A policy that needs no training, in the shape of an agent; its state is unused.

        random    every action uniform in [-1, 1], anew each step
        forward   straight ahead at full thrust; the Doggo pushes with all its motors
        seek      steers for the goal, or the box it must push, blind to all else

    Raises:
      ValueError: if there is no such policy for the robot.
    """
    known = [
        script for script in SCRIPTS if script != "seek" or env.config.robot in TURNS
    ]
    if name not in known:
        raise ValueError(
            f"policy must be one of {', '.join(known)} for a {env.config.robot}, "
            f"got {name!r}"
        )

    def policy(
        state: Any, obs: jax.Array, key: Key, deterministic: bool = False
    ) -> jax.Array:
        del state, deterministic
        return SCRIPTS[name](env, obs, key)

    def update(*_: Any) -> Any:
        raise NotImplementedError(f"the {name} policy does not learn")

    return Agent(lambda key: jnp.zeros(()), policy, update)


def _random(env: Env, obs: jax.Array, key: Key) -> jax.Array:
    shape = (*obs.shape[:-1], env.action_size)
    return jax.random.uniform(key, shape, obs.dtype, -1.0, 1.0)


def _forward(env: Env, obs: jax.Array, key: Key) -> jax.Array:
    del key
    action = [1.0, 0.0] if env.config.robot == "Point" else [1.0] * env.action_size
    return jnp.broadcast_to(
        jnp.array(action, obs.dtype), (*obs.shape[:-1], len(action))
    )


def _seek(env: Env, obs: jax.Array, key: Key) -> jax.Array:
    """The lidar's bins, as arrows from the robot, add up to where the target is."""
    del key
    target = "box_lidar" if env.config.task == "Push" else "goal_lidar"
    bins = obs[..., env.obs_slices[target]]
    angle = 2 * np.pi * (np.arange(bins.shape[-1]) + 0.5) / bins.shape[-1]
    ahead, action = TURNS[env.config.robot]
    x, y = (
        (bins * np.cos(angle - ahead)).sum(-1),
        (bins * np.sin(angle - ahead)).sum(-1),
    )
    return jnp.stack(action(jnp.arctan2(y, x)), -1)


# Direction that is ahead in the robot's frame, and how to drive towards a bearing.
# The Car faces its -y axis, so that its right motor is the left one to a driver.
TURNS: dict[str, tuple[float, Callable[[jax.Array], list[jax.Array]]]] = {
    "Point": (
        0.0,
        lambda bearing: [0.05 * jnp.cos(bearing), jnp.clip(1.5 * bearing, -1, 1)],
    ),
    "Car": (
        -np.pi / 2,
        lambda bearing: [
            0.02 * (jnp.cos(bearing) + turn * jnp.clip(1.5 * bearing, -1, 1))
            for turn in (1, -1)
        ],
    ),
}
SCRIPTS = {"random": _random, "forward": _forward, "seek": _seek}


def eval_summary(result: EvalResult) -> dict[str, float | int]:
    """Means with normal 95 % intervals over the valid episodes of one policy."""
    valid = np.asarray(result.valid) > 0
    count = int(valid.sum())

    def interval(values: jax.Array) -> tuple[float, float]:
        kept = np.asarray(values, np.float64)[valid]
        if count < 2:
            return float(kept.mean()) if count else float("nan"), float("nan")
        return float(kept.mean()), float(1.96 * kept.std(ddof=1) / np.sqrt(count))

    ep_return, ep_cost = interval(result.ep_return), interval(result.ep_cost)
    return {
        "return_mean": ep_return[0],
        "return_ci": ep_return[1],
        "cost_mean": ep_cost[0],
        "cost_ci": ep_cost[1],
        "violation_rate": float(result.violation_rate),
        "distance_travelled": interval(result.distance_travelled)[0],
        "episodes": count,
    }


def eval_summaries(results: EvalResult) -> list[dict[str, float | int]]:
    """`eval_summary` of each of several policies, fields [P, E]."""
    results = jax.tree.map(np.asarray, results)
    each = range(len(results.valid))
    return [eval_summary(jax.tree.map(lambda x, i=i: x[i], results)) for i in each]


def score_line(label: str, row: dict[str, Any]) -> str:
    """One row of `eval_summary` for people."""
    if not row["episodes"]:
        return f"{label}: of no valid episode nothing is known"
    return (
        f"{label}: return {row['return_mean']:.2f} +- {row['return_ci']:.2f}, "
        f"extrinsic cost {row['cost_mean']:.3f} +- {row['cost_ci']:.3f}, "
        f"violating episodes {row['violation_rate']:.1%} of {row['episodes']}"
    )
