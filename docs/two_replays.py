"""Draw the picture that the README begins with: two shipped policies in one layout.

    python docs/two_replays.py  # writes docs/two_replays.png

The policies and the episode are those of `autocost demo`. Its path of 1000 steps is
drawn, red where the robot is in a hazard, and each goal that the robot was given.
"""

from pathlib import Path

import matplotlib
import numpy as np

from autocost_jax.evaluate import Recording
from autocost_jax.viz.demo import EPISODES, LABELS, demo_train, play_demo

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle

OUT = Path(__file__).parent / "two_replays.png"
SEED, EDGE = 0, 2.4  # the latter: from the centre, metres


def draw(axis: Axes, recording: Recording, title: str) -> None:
    """One episode from above."""
    env = demo_train().env
    for place in recording.hazards:
        axis.add_patch(Circle(place, env.hazards_size, color="#7aa6e8", alpha=0.5))
    goals = np.unique(recording.goal_xy, axis=0)
    for place in goals:
        circle = Circle(place, env.goal_size, fill=False, color="#3a9a5b", lw=0.8)
        axis.add_patch(circle)
    path = recording.qpos[:, :2]
    parts = np.stack([path[:-1], path[1:]], axis=1)
    colors = np.where(recording.cost > 0, "#d62728", "#444444")
    axis.add_collection(LineCollection(list(parts), colors=list(colors), linewidths=1))
    axis.plot(*path[0], "o", color="k", ms=4)
    met = len(goals) - 1
    inside = int((recording.cost > 0).sum())
    axis.set_title(f"{title}\n{met} goals met, {inside} steps in a hazard", fontsize=9)
    axis.set(xlim=(-EDGE, EDGE), ylim=(-EDGE, EDGE), xticks=[], yticks=[])
    axis.set_aspect("equal")


def main() -> None:
    """Play both policies and write the picture."""
    recordings, lines = play_demo(SEED, EPISODES)
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.9), layout="constrained")
    for axis, recording, label in zip(axes, recordings, LABELS.values(), strict=True):
        draw(axis, recording, label)
    figure.savefig(OUT, dpi=110)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
