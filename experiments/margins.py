"""Safety margins against the evolved cost.

    python experiments/margins.py run      # what no other has trained
    python experiments/margins.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="margins",
    title="Safety margins against the evolved cost",
    paper=(
        "3x and the evolved cost reach zero; the evolved cost keeps much more return."
    ),
    designs=(
        "extrinsic",
        "margin_2x",
        "margin_3x",
        "steep",
        "evolved",
        "evolved_dense",
        "evolved_reduced",
    ),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
