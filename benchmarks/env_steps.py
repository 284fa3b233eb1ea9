"""How fast each world of this project steps, and how long it compiles.

    python benchmarks/env_steps.py                     # all, batch 1024
    python benchmarks/env_steps.py --only Goal-Hazard-Car --batch 128 8192

See `autocost_jax.bench.env_speed` for what a step is; `peers.py` compares. Writes
benchmarks/results/env_steps.json and the table of it; `--only` and `--batch` renew some
rows.
"""

import argparse
import dataclasses
import itertools
import json
import sys
from pathlib import Path
from typing import Any

from autocost_jax import env_config, list_envs
from autocost_jax.bench import env_speed
from autocost_jax.commandline import use_devices
from autocost_jax.runs.directory import run_facts

RESULT = Path(__file__).parent / "results" / "env_steps.json"
CLOSED_FORM = "Goal-Hazard-Point, closed form"
NAMES = (CLOSED_FORM, *list_envs())


def measure(name: str, batch: int, devices: Any) -> dict[str, Any]:
    """One row: a world's speed in a batch."""
    config = env_config(name.partition(",")[0])
    if name == CLOSED_FORM:
        config = dataclasses.replace(config, physics="closed_form")
    return {"name": name, **env_speed(config, batch, devices)._asdict()}


def render(result: dict[str, Any]) -> str:
    """The table of docs/performance.md."""
    rates = {
        (row["name"], row["worlds"]): f"{row['env_steps_per_second']:,}"
        for row in result["rows"]
    }
    batches = sorted({batch for _, batch in rates})
    lines = [
        f"| world | cold compile | {' | '.join(f'{b:,} worlds' for b in batches)} |",
        "|---" * (2 + len(batches)) + "|",
    ]
    for name in dict.fromkeys(name for name, _ in rates):
        own = [row for row in result["rows"] if row["name"] == name]
        cells = [rates.get((name, batch), "") for batch in batches]
        seconds = max(row["compile_seconds"] for row in own)
        lines.append(f"| {name} | {seconds:.1f} s | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print rows, write JSON and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--batch", type=int, nargs="+", default=(1024,))
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    devices = use_devices(None)
    old = json.loads(options.out.read_text())["rows"] if options.out.exists() else []
    rows = {(row["name"], row["worlds"]): row for row in old}
    for name, batch in itertools.product(options.only, options.batch):
        facts = run_facts()
        facts.pop("seed")
        row = measure(name, batch, devices)
        print(json.dumps(row), flush=True)
        row["command"] = " ".join(["python benchmarks/env_steps.py", *sys.argv[1:]])
        rows[name, batch] = row | {"facts": facts, "devices": len(devices)}
        order = sorted(rows, key=lambda key: (NAMES.index(key[0]), key[1]))
        result = {"rows": [rows[key] for key in order]}
        options.out.parent.mkdir(exist_ok=True)
        options.out.write_text(json.dumps(result, indent=1) + "\n")
        options.out.with_suffix(".md").write_text(render(result))


if __name__ == "__main__":
    main()
