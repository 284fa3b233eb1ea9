"""Do trained policies do the same in Safety-Gymnasium, by its own engine and code?

    python experiments/transfer.py run      # play exported policies there
    python experiments/transfer.py collect  # compare with our own fresh episodes

Plays the policies that `figures.py` has trained for other tasks and robots, in the
interpreter `--python` that has safety-gymnasium (`benchmarks/peers.py` makes one).
"""

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import paper
from common import t_interval

from autocost_jax.config import env_config
from autocost_jax.files import write_atomic
from autocost_jax.runs.directory import run_facts

SCRIPT = Path(__file__).parent / "transfer_safety_gymnasium.py"
PYTHON = Path("benchmarks/.venv/safety_gymnasium/bin/python")
WORLDS = ("Goal-Hazard-Point", "Goal-Hazard-Car")
DESIGNS = ("extrinsic", "evolved")
EPISODES = 10  # a policy; a reset there takes longer than a second


def run(runs: Path, python: Path, scale: paper.Scale, episodes: int) -> None:
    """Play each policy there; what has been played is kept."""
    if not python.exists():
        raise SystemExit(
            f"no {python}: `python benchmarks/peers.py --only safety_gymnasium` "
            "makes it, or name another one with --python"
        )
    for world, design, found in trained(runs, scale):
        file = played(found, design)
        if file.exists():
            continue
        rows = []
        for method, label in found.labels.items():
            for seed in scale.seeds:
                policy = found.path / "policies" / f"{label}_seed{seed}.npz"
                scores = play(python, policy, world, episodes, seed)
                rows.append({"method": method, "seed": seed} | scores)
                print(world, label, seed, np.mean(scores["return"]), flush=True)
        write_atomic(file, json.dumps(rows).encode())


def play(
    python: Path, policy: Path, world: str, episodes: int, seed: int
) -> dict[str, Any]:
    """Return and cost of each episode there."""
    env = env_config(world)
    numbers = [str(number) for number in (env.hazards_num, episodes, seed)]
    words = [str(python), str(SCRIPT), str(policy), env.robot, *numbers]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{policy}: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])


def trained(runs: Path, scale: paper.Scale) -> list[tuple[str, str, paper.Trained]]:
    """World, design and run of what has been trained."""
    worlds = [paper.in_world(world, scale.world) for world in WORLDS]
    designs = [design for design in DESIGNS if paper.exists(design, scale)]
    names = [(world, design) for world in worlds for design in designs]
    found = [(w, d, paper.find(runs, w, d, scale)) for w, d in names]
    return [(w, d, run) for w, d, run in found if run is not None]


def played(found: paper.Trained, design: str) -> Path:
    """What a design's policies did there."""
    return found.path / f"safety_gymnasium_{design}.json"


def compare(theirs: Sequence[Any], ours: Sequence[Any]) -> dict[str, Any]:
    """One method's policies in both engines; differences policy by policy."""
    result: dict[str, Any] = {
        "episodes_there": sum(len(row["return"]) for row in theirs),
        "episodes_here": sum(row["episodes"] for row in ours),
    }
    for key in ("return", "cost"):
        there = [float(np.mean(row[key])) for row in theirs]
        here = [row[f"{key}_mean"] for row in ours]
        result[key] = {
            "there": float(np.mean(there)),
            "here": float(np.mean(here)),
            "difference": t_interval(np.subtract(there, here)),
        }
    costs = np.concatenate([row["cost"] for row in theirs])
    there, count = int((costs > 0).sum()), len(costs)
    here = sum(round(row["violation_rate"] * row["episodes"]) for row in ours)
    result["violations"] = {
        "there": there,
        "here": here,
        "difference": rate_difference(there, count, here, result["episodes_here"]),
    }
    return result


def rate_difference(a: int, of_a: int, b: int, of_b: int) -> dict[str, float]:
    """The rate a / of_a less b / of_b, with Newcombe's 95 % interval (method 10)."""

    def wilson(x: int, n: int) -> tuple[float, float]:
        z = 1.959964
        middle = (x + z * z / 2) / (n + z * z)
        half = z / (n + z * z) * np.sqrt(x * (n - x) / n + z * z / 4)
        return middle - half, middle + half

    p, q = a / of_a, b / of_b
    (low_p, high_p), (low_q, high_q) = wilson(a, of_a), wilson(b, of_b)
    low = p - q - np.hypot(p - low_p, high_q - q)
    high = p - q + np.hypot(high_p - p, q - low_q)
    return {"mean": p - q, "low": float(low), "high": float(high)}


def collect(runs: Path, results: Path, scale: paper.Scale) -> None:
    """Write the JSON and the table."""
    rows = []
    for world, design, found in trained(runs, scale):
        if not played(found, design).exists():
            continue
        theirs = json.loads(played(found, design).read_text())
        ours = json.loads((found.path / "evaluation.json").read_text())["rows"]
        for method, label in found.labels.items():
            pair = [
                sorted(
                    (row for row in table if row["method"] == name),
                    key=lambda row: row["seed"],
                )
                for table, name in ((theirs, method), (ours, label))
            ]
            row = {"world": world, "design": design, "method": method}
            rows.append(row | compare(*pair))
    facts = run_facts()
    facts.pop("seed")
    result = {
        "title": "Policies in Safety-Gymnasium 1.0.0 (MuJoCo 2.3.3) and here",
        "command": paper.command("transfer", scale),
        "world": scale.world,
        "scale": scale.name,
        "facts": facts,
        "rows": rows,
    }
    file = paper.write(result, "transfer", results)
    file.with_suffix(".md").write_text(render(result))
    print(file)


def render(result: dict[str, Any]) -> str:
    """A line a method."""

    def cell(value: dict[str, Any], digits: int) -> str:
        gap = value["difference"]
        return (
            f"{value['there']:.{digits}f} / {value['here']:.{digits}f}, "
            f"{gap['mean']:+.{digits}f} ({gap['low']:.{digits}f} to "
            f"{gap['high']:.{digits}f})"
        )

    lines = [
        "| world | method | return there / here, difference (95 %) "
        "| cost, likewise | violating episodes there, here, difference (95 %) |",
        "|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        gap = row["violations"]["difference"]
        lines.append(
            f"| {row['world']} | {paper.label(row['design'], row['method'])} "
            f"| {cell(row['return'], 1)} | {cell(row['cost'], 2)} "
            f"| {row['violations']['there']} of {row['episodes_there']}, "
            f"{row['violations']['here']} of {row['episodes_here']}, "
            f"{gap['mean']:+.1%} ({gap['low']:.1%} to {gap['high']:.1%}) |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = paper.parser(__doc__)
    parser.add_argument("--python", type=Path, default=PYTHON)
    args = paper.arguments(parser)
    scale = paper.scales(args.world)[args.scale]
    if args.part == "run":
        run(args.runs, args.python, scale, 1 if args.smoke else EPISODES)
    else:
        collect(args.runs, args.results, scale)
