"""The cost of coming closer: max(d(t-1) - d(t), 0).

    python experiments/dense_cost.py run      # what no other has trained
    python experiments/dense_cost.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="dense_cost",
    title="The cost of coming closer: max(d(t-1) - d(t), 0)",
    paper=(
        "CPO reaches zero soon and loses its return; PPO-Lagrangian comes near "
        "zero with a good return."
    ),
    designs=("extrinsic", "distance_decrease"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
