"""Distance change, and its indicator (appendix).

    python experiments/distance_change.py run      # what no other has trained
    python experiments/distance_change.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="distance_change",
    title="Distance change, and its indicator (appendix)",
    paper=(
        "Distance change: neither reaches zero. Indicator: CPO zero, PPO-"
        "Lagrangian near zero, both lose their return."
    ),
    designs=("extrinsic", "distance_change", "distance_change_indicator"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
