"""Generalisation to other tasks and constraints.

    python experiments/other_tasks.py run      # what no other has trained
    python experiments/other_tasks.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="other_tasks",
    title="Generalisation to other tasks and constraints",
    paper=(
        "With the evolved cost both algorithms reach zero in all four worlds at"
        " a lower return; without it neither does."
    ),
    designs=("unconstrained", "extrinsic", "evolved"),
    worlds=(
        "Goal-Hazard-Point",
        "Goal-Pillar-Point",
        "Push-Hazard-Point",
        "Push-Pillar-Point",
    ),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
