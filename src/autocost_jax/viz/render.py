"""One episode of a policy, recorded and shown: a page, and a film if asked for."""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from autocost_jax.agents.base import Agent
from autocost_jax.config import EnvConfig, TrainConfig, env_config
from autocost_jax.costs import load_cost
from autocost_jax.envs.env import Env, make_env
from autocost_jax.evaluate import Recording, first_recording, watch_first
from autocost_jax.files import write_atomic
from autocost_jax.population import make_evaluator
from autocost_jax.records import root_key
from autocost_jax.runs.artifacts import read_object
from autocost_jax.runs.policies import (
    EVALUATION,
    load_policies,
    policy_files,
    scripted_agent,
)
from autocost_jax.viz.cost_map import network_cost
from autocost_jax.viz.markup import number
from autocost_jax.viz.picture import Camera, Job, draw, film_size, why_not
from autocost_jax.viz.player import replay_page
from autocost_jax.viz.scene import make_replay


@dataclass(frozen=True, eq=False)
class Player:
    """A policy that can act, and where.

    Attributes:
      world: name for people of the world it acts in.
      config: that world.
      name: its own name.
      actions: "sampled", "mean" or "scripted".
      make_agent: environment -> agent and its state.
      page: where its replay goes by default.
      theta: [D] the intrinsic cost that it was trained with, or None.
    """

    world: str
    config: EnvConfig
    name: str
    actions: str
    make_agent: Any
    page: Path
    theta: np.ndarray | None = None

    def with_steps(self, steps: int | None) -> "Player":
        """The same in episodes of that length; None leaves it as it is."""
        if steps is None:
            return self
        if steps < 1:
            raise ValueError(f"steps must be >= 1, got {steps}")
        return dataclasses.replace(
            self, config=dataclasses.replace(self.config, num_steps=steps)
        )


def script_player(env: str, policy: str) -> Player:
    """A scripted policy in one of the known worlds; see `scripted_agent`.

    Raises:
      ValueError: the world is unknown, or the policy for its robot.
    """
    config = env_config(env)
    if config.has_closed_form:  # the same numbers, sooner
        config = dataclasses.replace(config, physics="closed_form")
    scripted_agent(policy, make_env(config))  # refuses a bad name

    def make_agent(world: Env) -> tuple[Agent, Any]:
        agent = scripted_agent(policy, world)
        return agent, agent.init(root_key(0))

    page = Path("runs/replays") / f"{env}-{policy}.html"
    return Player(env, config, policy, "scripted", make_agent, page)


def best_policy(run: Path) -> str | None:
    """The first algorithm's policy under a search's best cost; None if unknown."""
    evaluation = read_object(run / "cost.json").get("evaluation")
    names = list(evaluation) if isinstance(evaluation, dict) else []
    return f"best_{names[0]}" if names else None


def run_player(
    run: Path, config: Any, policy: str | None, deterministic: bool = False
) -> Player:
    """A saved policy of a run directory.

    Args:
      run: the run directory.
      config: its configuration, which has a field `train`.
      policy: file stem in policies/; None for the last one.
      deterministic: act by the mean instead of sampling.

    Raises:
      RunDirError: there is no such policy; the message lists those that exist.
    """
    train: TrainConfig = config.train
    file = policy_files(run, [] if policy is None else [policy])[-1]

    def make_agent(env: Env) -> tuple[Agent, Any]:
        agent, states = load_policies(env, train, [file])
        return agent, jax.tree.map(lambda leaf: leaf[0], states)

    theta, cost = None, run / "cost.npz"
    if cost.exists() and file.stem.startswith("best_"):
        theta = np.asarray(load_cost(cost))
    return Player(
        world=train.env.name,
        config=train.env,
        name=file.stem,
        actions="mean" if deterministic else "sampled",
        make_agent=make_agent,
        page=run / "replays" / f"{file.stem}.html",
        theta=theta,
    )


def record_episode(player: Player, seed: int) -> Recording:
    """One whole episode: that of `autocost evaluate --episodes 1 --seed SEED`."""
    env = make_env(player.config)
    agent, state = player.make_agent(env)
    is_mean = player.actions == "mean"
    run = make_evaluator(env, agent, 1, is_mean, first_recording, watch=watch_first)
    key = jax.random.fold_in(root_key(seed), EVALUATION)
    _, kept = run(jax.tree.map(lambda leaf: leaf[None], state), key)
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), kept)


def show(
    player: Player,
    *,
    seed: int = 0,
    out: Path | None = None,
    video: Path | None = None,
    camera: Camera = "track",
    size: tuple[int, int] | None = None,
) -> Iterator[str]:
    """Record an episode and write its page and film; yields lines for people.

    Where no film can be made, the last line says what is missing.
    """
    title = f"{player.world}, {player.name}"
    steps = player.config.num_steps
    yield f"{title}: compiling, then {steps} steps ..."
    recording = record_episode(player, seed)
    cost = np.asarray(recording.cost)
    yield (
        f"return {recording.reward.sum():.2f}, extrinsic cost {cost.sum():.3f} in "
        f"{int((cost > 0).sum())} of {steps} steps"
    )
    path = out or player.page
    write_atomic(path, replay_html(player, recording, seed).encode())
    yield f"{path.stat().st_size / 1e6:.1f} MB; open {path}"
    if video is None:
        return
    missing = why_not(video.suffix)
    if missing is not None:
        yield f"no film: {missing}"
        return
    yield "drawing the film ..."
    size = film_size(video, size)
    draw([Job(player.config, recording, video, size, camera, title)])
    yield f"{video.stat().st_size / 1e6:.1f} MB; watch {video}"


def replay_html(player: Player, recording: Recording, seed: int) -> str:
    """The page of a recorded episode."""
    intrinsic = None
    if player.theta is not None:
        intrinsic = network_cost(player.theta, recording.constraint_lidar)
    replay = make_replay(
        player.config, recording, intrinsic=intrinsic, label=player.name
    )
    title = f"{player.world}, {player.name}"
    return replay_page(title, _facts(player, recording, seed), replay)


def _facts(
    player: Player, recording: Recording, seed: int
) -> Mapping[str, tuple[str, str]]:
    cost, config = np.asarray(recording.cost), player.config
    steps, hits = len(cost), int((cost > 0).sum())
    met = int(np.any(np.diff(recording.goal_xy, axis=0) != 0, axis=-1).sum())
    task = "drive to the goal" if config.task == "Goal" else "push the box to the goal"
    return {
        "World": (player.world, f"{config.robot}: {task}, avoid {_avoid(config)}"),
        "Policy": (player.name, f"{player.actions} actions, seed {seed}"),
        "Return": (number(recording.reward.sum()), f"{met} goals met in {steps} steps"),
        "Extrinsic cost": (number(cost.sum()), f"in {hits} of {steps} steps"),
    }


def _avoid(config: EnvConfig) -> str:
    return " and ".join(config.constrained)
