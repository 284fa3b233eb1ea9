"""Cost limits 0.5 and 0 (introduction).

    python experiments/cost_limits.py run      # what no other has trained
    python experiments/cost_limits.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="cost_limits",
    title="Cost limits 0.5 and 0 (introduction)",
    paper=(
        "Costs come to rest near the limit of 0.5; with a limit of 0 both "
        "algorithms stay above zero."
    ),
    designs=("limit_0.5", "extrinsic"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
