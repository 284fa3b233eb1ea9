"""How fast each of the twelve worlds steps, and how long it compiles.

    python benchmarks/env_steps.py                     # all, batch 1024
    python benchmarks/env_steps.py --only Goal-Hazard-Car --batch 128

See `autocost_jax.bench.env_speed` for what a step is. Writes
benchmarks/results/env_steps.json and the table of it; `--only` renews some rows.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from autocost_jax import env_config, list_envs
from autocost_jax.bench import env_speed
from autocost_jax.commandline import use_devices
from autocost_jax.store import run_facts

RESULT = Path(__file__).parent / "results" / "env_steps.json"
CLOSED_FORM = "Goal-Hazard-Point, closed form"
NAMES = (CLOSED_FORM, *list_envs())
# Env steps a second of one Safety-Gymnasium 1.0.0 process, without its resets, on two
# such cores; measured once, apart from this script, which cannot install it.
PEERS = {
    "Goal-Point": ("PointGoal1", 1375),
    "Goal-Car": ("CarGoal1", 779),
    "Goal-Doggo": ("DoggoGoal1", 544),
    "Push-Point": ("PointPush1", 833),
}


def measure(name: str, batch: int, devices: Any) -> dict[str, Any]:
    """One row: a world's speed, and its ratio to the nearest peer."""
    config = env_config(name.partition(",")[0])
    if name == CLOSED_FORM:
        config = dataclasses.replace(config, physics="closed_form")
    row = {"name": name, **env_speed(config, batch, devices)._asdict()}
    peer = PEERS.get(f"{config.task}-{config.robot}")
    if peer is not None:
        row["peer"], rate = peer
        row["ratio"] = round(row["env_steps_per_second"] / rate, 1)
    return row


def render(result: dict[str, Any]) -> str:
    """The table of the README."""
    lines = [
        "| world | cold compile | env steps/s | one Safety-Gymnasium process |",
        "|---|---|---|---|",
    ]
    for row in result["rows"]:
        ratio = f"{row['ratio']} x {row['peer']}" if "ratio" in row else ""
        lines.append(
            f"| {row['name']} | {row['compile_seconds']:.1f} s | "
            f"{row['env_steps_per_second']:,} | {ratio} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print rows, write JSON and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    devices = use_devices(None)
    old = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    rows = {row["name"]: row for row in old}
    for name in options.only:
        rows[name] = measure(name, options.batch, devices)
        print(json.dumps(rows[name]), flush=True)
        facts = run_facts()
        facts.pop("seed")
        result = {
            "command": " ".join(["python benchmarks/env_steps.py", *sys.argv[1:]]),
            "facts": facts,
            "devices": len(devices),
            "peer": "one Safety-Gymnasium 1.0.0 process, resets not counted",
            "rows": [rows[name] for name in NAMES if name in rows],
        }
        options.out.parent.mkdir(exist_ok=True)
        options.out.write_text(json.dumps(result, indent=1) + "\n")
        options.out.with_suffix(".md").write_text(render(result))


if __name__ == "__main__":
    main()
