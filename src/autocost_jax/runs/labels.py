"""What algorithms and costs are called in front of people."""

ALGORITHM_LABELS = {
    "ppo_lagrangian": "PPO-Lagrangian",
    "cpo": "CPO",
    "focops": "FOCOPS",
    "pid_lagrangian": "PID-Lagrangian",
}
COST_LABELS = {  # what agents are compared on, in the order of the summary
    "extrinsic": "extrinsic cost alone",
    "safety_margin_3x": "3x margin by hand",
    "best": "best cost found",
}


def algorithm_label(name: str) -> str:
    """The label of an algorithm; an algorithm of the user's own keeps its name."""
    return ALGORITHM_LABELS.get(name, name)
