"""How fast a preset's program compiles and runs; one program against many.

    python benchmarks/population.py --preset laptop
    python benchmarks/population.py --preset paper --parts mjx closed_form

See `autocost_jax.bench`: the search's program with and without updates, and one
algorithm's programs of 1 to 16 slots, on at most one device a slot. Writes
benchmarks/results/population_PRESET.json and the table of it.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from autocost_jax import PRESETS, preset
from autocost_jax.bench import Speed, search_speeds, slot_speeds
from autocost_jax.commandline import use_devices
from autocost_jax.config import SearchConfig
from autocost_jax.store import run_facts

RESULTS = Path(__file__).parent / "results"
SIZES = (1, 4, 16)
PARTS = ("mjx", "closed_form", "slots")
# Env steps a second of one omnisafe 0.5.0 run, nets 64-64, updates included, on two
# such cores; measured once, apart from this script, which cannot install it.
OMNISAFE = {"ppo_lagrangian": 90, "cpo": 199}


def render(result: dict[str, Any]) -> str:
    """The table of the README."""
    lines = [
        "| program | worlds | cold compile | env steps/s | one omnisafe run |",
        "|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        rate = result["omnisafe"].get(row["what"].partition(",")[0])
        ratio = f"{row['env_steps_per_second'] / rate:,.0f} x" if rate else ""
        lines.append(
            f"| {row['what'].replace(', 1 slots', ', 1 slot').replace('_', '-')}, "
            f"{row['physics'].replace('_', ' ')} | {row['worlds']} | "
            f"{row['compile_seconds']:.1f} s | {row['env_steps_per_second']:,} | "
            f"{ratio} |"
        )
    return "\n".join(lines) + "\n"


def with_physics(config: SearchConfig, physics: Any) -> SearchConfig:
    """The same search with another model of the world."""
    env = dataclasses.replace(config.train.env, physics=physics)
    train = dataclasses.replace(config.train, env=env)
    return dataclasses.replace(config, train=train)


def main() -> None:
    """Measure, print rows, write JSON and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", choices=PRESETS, default="laptop")
    parser.add_argument("--devices", type=int, default=None)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder")
    options = parser.parse_args()
    devices = use_devices(options.devices)
    config = preset(options.preset)
    fast = with_physics(config, "closed_form")
    rows: list[Speed] = []

    def keep(new: list[Speed]) -> None:
        for row in new:
            print(json.dumps(row._asdict()), flush=True)
        rows.extend(new)

    if "mjx" in options.parts:
        keep(search_speeds(config, devices))
    if "closed_form" in options.parts:
        keep(search_speeds(fast, devices))
    for algorithm in config.algorithms if "slots" in options.parts else ():
        keep(slot_speeds(fast.train, algorithm, SIZES, devices))
    # What the whole search takes at these rates, compile and evaluation apart.
    hours = {
        row.physics: config.env_steps / row.env_steps_per_second / 3600
        for row in rows
        if row.what == "with updates"
    }
    facts = run_facts()
    facts.pop("seed")
    result = {
        "command": " ".join(["python benchmarks/population.py", *sys.argv[1:]]),
        "facts": facts,
        "devices": len(devices),
        "omnisafe": OMNISAFE,
        "search_hours": {name: round(value, 4) for name, value in hours.items()},
        "rows": [row._asdict() for row in rows],
    }
    file = options.out / f"population_{options.preset}.json"
    print(json.dumps({"search_hours": result["search_hours"]}))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")
    file.with_suffix(".md").write_text(render(result))


if __name__ == "__main__":
    main()
