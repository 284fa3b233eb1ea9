"""An exported policy in Safety-Gymnasium: NumPy and its own engine, nothing of ours.

    python experiments/transfer_safety_gymnasium.py POLICY.npz Point 4 20 0

Needs an interpreter with safety-gymnasium 1.0.0 (Python 3.10). The Goal-Hazard world
of this project is set up by Safety-Gymnasium's own task: here 4 hazards of 0.3 m,
keepouts 0.4 m, extents 2 m, lidars of 8 exponential bins, depth as cost. 20 episodes
with seed 0. Prints one line of JSON: return and cost of each episode.
"""

import json
import sys
from typing import Any

import numpy as np
import safety_gymnasium
from safety_gymnasium.assets.geoms import Goal, Hazards
from safety_gymnasium.bases.base_task import BaseTask
from safety_gymnasium.builder import Builder
from safety_gymnasium.tasks.safe_navigation.goal.goal_level0 import GoalLevel0


class GoalHazard(GoalLevel0):
    """Goal-Hazard as this project's default, with `hazards` of them."""

    hazards = 4

    def __init__(self, config: dict[str, Any]) -> None:
        BaseTask.__init__(self, config=config)
        self.placements_conf.extents = [-2, -2, 2, 2]
        self._add_geoms(
            Goal(keepout=0.4), Hazards(num=self.hazards, size=0.3, keepout=0.4)
        )
        self.lidar_conf.num_bins = 8
        self.lidar_conf.max_dist = None  # exponential
        self.cost_conf.constrain_indicator = False
        self.last_dist_goal = None


def make(robot: str, hazards: int) -> Builder:
    """The world, with observations by name."""
    GoalHazard.hazards = hazards
    safety_gymnasium.tasks.GoalLevel1 = GoalHazard  # where the builder looks it up
    config = {"agent_name": robot, "observation_flatten": False}
    return Builder(f"Safety{robot}Goal1-v0", config=config)


def act(policy: dict[str, np.ndarray], obs: Any, rng: np.random.Generator) -> Any:
    """A sampled action: tanh layers, a linear mean, one deviation an action."""
    x = np.concatenate([np.ravel(obs[name]) for name in sorted(obs)])
    last = sum(name.endswith("kernel") for name in policy) - 1
    for layer in range(last + 1):
        name = f"mean/Dense_{layer}"
        x = x @ policy[f"{name}/kernel"] + policy[f"{name}/bias"]
        x = np.tanh(x) if layer < last else x
    return x + np.exp(policy["log_std"]) * rng.standard_normal(x.shape)


def play(
    path: str, robot: str, hazards: int, episodes: int, seed: int
) -> dict[str, list[float]]:
    """Whole episodes: their returns and costs."""
    with np.load(path, allow_pickle=False) as file:
        policy = {name: file[name].astype(np.float64) for name in file.files}
    env, rng = make(robot, hazards), np.random.default_rng(seed)
    result: dict[str, list[float]] = {"return": [], "cost": []}
    for episode in range(episodes):
        obs, _ = env.reset(seed=1000 * seed + episode)
        total, total_cost, done = 0.0, 0.0, False
        while not done:
            action = np.clip(act(policy, obs, rng), -1, 1)
            obs, reward, cost, terminated, truncated, _ = env.step(action)
            total, total_cost = total + reward, total_cost + cost
            done = terminated or truncated
        result["return"].append(round(float(total), 4))
        result["cost"].append(round(float(total_cost), 6))
    return result


if __name__ == "__main__":
    file, robot, *numbers = sys.argv[1:]
    print(json.dumps(play(file, robot, *map(int, numbers))))
