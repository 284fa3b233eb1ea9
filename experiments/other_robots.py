"""Generalisation to other robots.

    python experiments/other_robots.py run      # what no other has trained
    python experiments/other_robots.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="other_robots",
    title="Generalisation to other robots",
    paper=(
        "Car: both reach zero with the evolved cost. Doggo: PPO-Lagrangian "
        "alone does; CPO learns nothing there."
    ),
    designs=("unconstrained", "extrinsic", "evolved"),
    worlds=("Goal-Hazard-Car", "Goal-Hazard-Doggo"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
