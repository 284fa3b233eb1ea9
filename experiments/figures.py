"""The figures of the paper, by name: what each compares, and what the paper says.

    python experiments/figures.py run cost_limits      # train what is not trained yet
    python experiments/figures.py collect cost_limits  # JSON, table, picture

See `paper.py` for the designs, the scales and the statistics.
"""

from paper import Figure, main

FIGURES = (
    Figure(
        name="cost_limits",
        title="Cost limits 0.5 and 0 (introduction)",
        paper=(
            "Costs come to rest near the limit of 0.5; with a limit of 0 both "
            "algorithms stay above zero."
        ),
        designs=("limit_0.5", "extrinsic"),
    ),
    Figure(
        name="negative_limits",
        title="Cost limits -0.1 and -1",
        paper=(
            "CPO: near zero at -0.1, zero at -1, with a large loss of return; PPO-"
            "Lagrangian is not affected."
        ),
        designs=("extrinsic", "limit_-0.1", "limit_-1"),
    ),
    Figure(
        name="dense_cost",
        title="The cost of coming closer: max(d(t-1) - d(t), 0)",
        paper=(
            "CPO reaches zero soon and loses its return; PPO-Lagrangian comes near "
            "zero with a good return."
        ),
        designs=("extrinsic", "distance_decrease"),
    ),
    Figure(
        name="distance_change",
        title="Distance change, and its indicator (appendix)",
        paper=(
            "Distance change: neither reaches zero. Indicator: CPO zero, PPO-"
            "Lagrangian near zero, both lose their return."
        ),
        designs=("extrinsic", "distance_change", "distance_change_indicator"),
    ),
    Figure(
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
    ),
    Figure(
        name="other_robots",
        title="Generalisation to other robots",
        paper=(
            "Car: both reach zero with the evolved cost. Doggo: PPO-Lagrangian "
            "alone does; CPO learns nothing there."
        ),
        designs=("unconstrained", "extrinsic", "evolved"),
        worlds=("Goal-Hazard-Car", "Goal-Hazard-Doggo"),
    ),
    Figure(
        name="margins",
        title="Safety margins against the evolved cost",
        paper=(
            "3x and the evolved cost reach zero; the evolved cost keeps much more "
            "return."
        ),
        designs=(
            "extrinsic",
            "margin_1x",
            "margin_2x",
            "margin_3x",
            "steep",
            "evolved",
            "evolved_dense",
            "evolved_reduced",
        ),
    ),
    Figure(
        name="without_extrinsic",
        title="With and without the extrinsic cost",
        paper=(
            "The evolved cost alone violates far less than the extrinsic cost "
            "alone, but not never."
        ),
        designs=("extrinsic", "evolved", "evolved_alone"),
    ),
    Figure(
        name="total_cost",
        title="Extrinsic plus intrinsic cost under the evolved cost",
        paper=(
            "The sum stays above zero for both algorithms, while the extrinsic cost "
            "goes to zero."
        ),
        designs=("evolved",),
        curves=("ep_total_cost", "ep_cost"),
    ),
)

if __name__ == "__main__":
    main(FIGURES, __doc__)
