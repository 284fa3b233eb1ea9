"""How fast a preset's program compiles and runs; one program against many.

    python benchmarks/population.py --preset laptop
    python benchmarks/population.py --preset paper --parts mjx closed_form update
    python benchmarks/population.py --preset laptop --parts devices --devices 8

See `autocost_jax.bench` and `programs.py`: the search's program and what it is made of
(mjx, closed_form); one algorithm's programs of 1 to 100 slots, on at most one device a
slot (slots); 16 slots on 1, 2, 4 ... devices (devices); a compile without and with a
cache (compile); updates against the devices' own matrix products (update). Writes
benchmarks/results/population_PRESET.json and the table of it; parts that are not asked
for stay as they were.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from programs import compile_times, device_speeds, update_speed

from autocost_jax import PRESETS, preset
from autocost_jax.bench import search_speeds, slot_speeds
from autocost_jax.commandline import use_devices
from autocost_jax.config import Precision, SearchConfig, TrainConfig
from autocost_jax.runs.directory import run_facts

RESULTS = Path(__file__).parent / "results"
SIZES, DEALT = (1, 4, 16, 100), 16
PARTS = ("mjx", "closed_form", "slots", "devices", "compile", "update")


def render(result: dict[str, Any]) -> str:
    """The tables of docs/performance.md, a part each."""
    parts = result["parts"]
    rows = [row for part in PARTS[:4] for row in parts.get(part, {}).get("rows", ())]
    lines = []
    if rows:
        lines += [
            "| program | worlds | cold compile | workspace of a device | env steps/s |",
            "|---|---|---|---|---|",
        ]
    for row in rows:
        name = row["what"].replace(", 1 slots", ", 1 slot").replace("_", "-")
        name = name.replace(", 1 devices", ", 1 device")
        lines.append(
            f"| {name}, {row['physics'].replace('_', ' ')} | {row['worlds']} | "
            f"{row['compile_seconds']:.1f} s | {row['workspace_bytes'] / 1e6:.1f} MB | "
            f"{row['env_steps_per_second']:,} |"
        )
    if "compile" in parts:
        lines += ["", "| program | cold compile | warm |", "|---|---|---|"]
        lines += [
            f"| {row['physics'].replace('_', ' ')} | {row['cold']:.1f} s | "
            f"{row['warm']:.1f} s |"
            for row in parts["compile"]["rows"]
        ]
    if "update" in parts:
        lines += [
            "",
            "| update of | slots x rows | critics | seconds | TFLOP | TFLOP/s "
            "| matrix products alone | share |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row in parts["update"]["rows"]:
            lines.append(
                f"| {row['algorithm'].replace('_', '-')} | "
                f"{row['slots']} x {row['rows']:,} | "
                f"{row['precision']} | {row['seconds']:.2f} | "
                f"{row['tera_flop']:.3f} | {row['tera_flop_per_second']:.3f} | "
                f"{row['matmul_tera_flop_per_second']:.3f} | {row['share']:.0%} |"
            )
    return "\n".join(lines).strip() + "\n"


def with_physics(config: SearchConfig, physics: Any) -> SearchConfig:
    """The same search with another model of the world."""
    env = dataclasses.replace(config.train.env, physics=physics)
    train = dataclasses.replace(config.train, env=env)
    return dataclasses.replace(config, train=train)


def with_chunks(config: SearchConfig, epochs: int) -> SearchConfig:
    """The same search with chunks of another length."""
    train = dataclasses.replace(config.train, chunk_epochs=epochs)
    return dataclasses.replace(config, train=train)


def with_precision(train: TrainConfig, precision: Precision) -> TrainConfig:
    """The same training with critics of another precision."""
    agent = dataclasses.replace(train.agent, critic_precision=precision)
    return dataclasses.replace(train, agent=agent)


def main() -> None:
    """Measure, print rows, write JSON and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", choices=PRESETS, default="laptop")
    parser.add_argument("--devices", type=int, default=None)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument(
        "--precisions", nargs="+", choices=get_args(Precision), default=["float32"]
    )
    parser.add_argument("--update-slots", type=int, help="default: one a device")
    parser.add_argument("--chunk-epochs", type=int, help="in a call; default: preset's")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder")
    options = parser.parse_args()
    devices = use_devices(options.devices)
    config = preset(options.preset)
    if options.chunk_epochs:
        config = with_chunks(config, options.chunk_epochs)
    fast = with_physics(config, "closed_form")
    measure: dict[str, Callable[[], list[Any]]] = {
        "mjx": lambda: search_speeds(config, devices),
        "closed_form": lambda: search_speeds(fast, devices),
        "slots": lambda: [
            row
            for algorithm in config.algorithms
            for row in slot_speeds(fast.train, algorithm, SIZES, devices)
        ],
        "devices": lambda: [
            row
            for algorithm in config.algorithms
            for row in device_speeds(fast.train, algorithm, DEALT, devices)
        ],
        "compile": lambda: [compile_times(kind, devices) for kind in (config, fast)],
        "update": lambda: [
            update_speed(
                with_precision(fast.train, precision),
                algorithm,
                options.update_slots or len(devices),
                devices,
            )
            for precision in options.precisions
            for algorithm in config.algorithms
        ],
    }
    file = options.out / f"population_{options.preset}.json"
    result: dict[str, Any] = {"parts": {}}
    if file.exists():
        result = json.loads(file.read_text())
    for part in options.parts:
        rows = [row._asdict() for row in measure[part]()]
        for row in rows:
            print(json.dumps(row), flush=True)
        facts = run_facts()
        facts.pop("seed")
        result["parts"][part] = {
            "command": " ".join(["python benchmarks/population.py", *sys.argv[1:]]),
            "facts": facts,
            "devices": len(devices),
            "rows": rows,
        }
        # What the whole search takes at this rate, compile and evaluation apart.
        for row in rows:
            if row.get("what") == "with updates":
                hours = config.env_steps / row["env_steps_per_second"] / 3600
                result["parts"][part]["search_hours"] = round(hours, 4)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")
    file.with_suffix(".md").write_text(render(result))


if __name__ == "__main__":
    main()
