"""`autocost demo`: two shipped policies side by side, without any training."""

import dataclasses
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from autocost_jax.config import AgentConfig, TrainConfig, env_config
from autocost_jax.costs import load_cost
from autocost_jax.envs.env import make_env
from autocost_jax.evaluate import Recording, first_recording, watch_first
from autocost_jax.population import make_evaluator
from autocost_jax.records import root_key
from autocost_jax.runs.policies import load_policies
from autocost_jax.viz.cost_map import network_cost
from autocost_jax.viz.report import write_comparison
from autocost_jax.viz.scene import make_replay

WORLD = "Goal-Hazard-Point"
EPISODES = 100  # that the scores are of
FOUND = "lidar_mlp"  # the best shipped cost of this world
LABELS = {
    "extrinsic": "CPO, extrinsic cost alone",
    FOUND: f"CPO, with the cost {FOUND}",
}


class Demo(NamedTuple):
    """What a demo shows.

    Attributes:
      page: the file to open.
      lines: scores for people.
    """

    page: Path
    lines: list[str]


def demo_train() -> TrainConfig:
    """The world and networks that the shipped policies were trained with."""
    return TrainConfig(
        env=dataclasses.replace(env_config(WORLD), physics="closed_form"),
        agent=AgentConfig(hidden_sizes=(64, 64), normalize_obs=True),
    )


def play_demo(seed: int, num_episodes: int) -> tuple[list[Recording], list[str]]:
    """An episode of each shipped policy, in the order of `LABELS`, and their scores.

    Args:
      seed: of the layouts, which both agents meet, and of the actions.
      num_episodes: that the scores are of; the first is recorded.
    """
    train = demo_train()
    env = make_env(train.env)
    folder = Path(str(resources.files("autocost_jax"))) / "pretrained" / "policies"
    files = [folder / f"{name}_cpo.npz" for name in LABELS]
    agent, states = load_policies(env, train, files)
    evaluate = make_evaluator(
        env, agent, num_episodes, keep=first_recording, watch=watch_first
    )
    result, kept = evaluate(states, root_key(seed))
    recordings = [
        jax.tree.map(lambda x, i=i: np.asarray(x[i]), kept) for i in range(len(LABELS))
    ]
    lines = [
        f"{label}: return {float(result.ep_return[i].mean()):.1f}, "
        f"{float(result.violation_rate[i]):.0%} of {num_episodes} episodes violate"
        for i, label in enumerate(LABELS.values())
    ]
    return recordings, lines


def write_demo(out: Path, seed: int = 0, num_episodes: int = EPISODES) -> Demo:
    """Replay CPO's agents under the extrinsic cost alone and under a found cost.

    Args:
      out: folder of the page.
      seed: of the layouts, which both agents meet, and of the actions.
      num_episodes: that the scores are of; the first is shown.
    """
    recordings, lines = play_demo(seed, num_episodes)
    theta, world = np.asarray(load_cost(FOUND)), demo_train().env
    replays = []
    for (name, label), recording in zip(LABELS.items(), recordings, strict=True):
        intrinsic = None
        if name == FOUND:
            intrinsic = network_cost(theta, recording.constraint_lidar)
        replays.append(make_replay(world, recording, intrinsic=intrinsic, label=label))
    text = (
        "The same world, the same learner, the same number of steps. Both robots drive "
        "to goals; the discs are hazards, which cost something while one is inside. "
        f"{lines[0]}. {lines[1]}."
    )
    page = write_comparison(replays, f"{WORLD}: two costs", text, out / "index.html")
    return Demo(page, lines)
