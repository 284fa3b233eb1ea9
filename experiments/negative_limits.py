"""Cost limits -0.1 and -1.

    python experiments/negative_limits.py run      # what no other has trained
    python experiments/negative_limits.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="negative_limits",
    title="Cost limits -0.1 and -1",
    paper=(
        "CPO: near zero at -0.1, zero at -1, with a large loss of return; PPO-"
        "Lagrangian is not affected."
    ),
    designs=("extrinsic", "limit_-0.1", "limit_-1"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
