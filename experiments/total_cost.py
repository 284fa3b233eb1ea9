"""The training cost never reaches zero while the extrinsic one falls.

    python experiments/total_cost.py run      # what no other has trained
    python experiments/total_cost.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="total_cost",
    title="Extrinsic plus intrinsic cost under the evolved cost",
    paper=(
        "The sum stays above zero for both algorithms, while the extrinsic cost goes "
        "to zero."
    ),
    designs=("evolved",),
    curves=("ep_total_cost", "ep_cost"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
