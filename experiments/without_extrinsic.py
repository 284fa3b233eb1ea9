"""With and without the extrinsic cost.

    python experiments/without_extrinsic.py run      # what no other has trained
    python experiments/without_extrinsic.py collect  # JSON, table, picture of all runs

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURE = Figure(
    name="without_extrinsic",
    title="With and without the extrinsic cost",
    paper=(
        "The evolved cost alone violates far less than the extrinsic cost "
        "alone, but not never."
    ),
    designs=("extrinsic", "evolved", "evolved_alone"),
)

if __name__ == "__main__":
    main(FIGURE, __doc__)
