"""Which parts of a robot touch each other or the floor, and how often?

    python experiments/touches.py run      # 1,000,000 steps a robot, in MuJoCo C
    python experiments/touches.py collect  # JSON and table

The whole scene of Safety Gym is driven for 250 steps at a time from its start, by six
kinds of actions in turn: uniform, constant and alternating extremes, extremes drawn
anew every few steps, smooth noise, and sines. Counted are the control steps after which
a pair of geoms touches. What the reduced model leaves out must be rare: below 1 in
10,000 steps.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco as untyped_mujoco
import numpy as np
from common import Options, compact, run_part

from autocost_jax.config import EnvConfig
from autocost_jax.envs.physics.models import physics_model, scene_model
from autocost_jax.runs.directory import run_facts

mujoco: Any = untyped_mujoco  # its compiled names have no stubs
ROBOTS = ("Point", "Car", "Doggo")
KINDS = ("uniform", "constant", "alternating", "bang-bang", "smooth", "sines")
STEPS, EPISODE = 1_000_000, 250
RARE = 1e-4  # share of the steps in which what is left out may touch


def actions(kind: str, size: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Actions [size] of one episode."""
    extreme = rng.choice([-1.0, 1.0], size)
    if rng.random() < 0.3:  # all motors the same way
        extreme = np.full(size, rng.choice([-1.0, 1.0]))
    period, noise = int(rng.integers(1, 40)), np.zeros(size)
    phase, pace = rng.uniform(0, 2 * np.pi, size), rng.uniform(0.02, 0.6, size)
    for step in range(EPISODE):
        if kind == "uniform":
            yield rng.uniform(-1, 1, size)
        elif kind == "smooth":
            noise = 0.9 * noise + 0.5 * rng.normal(size=size)
            yield np.clip(noise, -1, 1)
        elif kind == "sines":
            yield np.sin(pace * step + phase)
        else:
            if kind == "bang-bang" and step % period == 0:
                extreme = rng.choice([-1.0, 1.0], size)
            turned = kind == "alternating" and (step // period) % 2
            yield -extreme if turned else extreme


def survey(robot: str, steps: int, seed: int = 0) -> dict[str, Any]:
    """Share of the steps that each pair touches, and contacts at a time."""
    rng = np.random.default_rng(seed)
    model = scene_model(EnvConfig(robot=robot, hazards_num=1))  # pyright: ignore
    data = mujoco.MjData(model)
    names = [model.geom(i).name for i in range(model.ngeom)]
    pairs, sizes = Counter(), Counter()
    for episode in range(steps // EPISODE):
        mujoco.mj_resetData(model, data)
        for action in actions(KINDS[episode % len(KINDS)], model.nu, rng):
            data.ctrl[:] = action
            mujoco.mj_step(model, data, nstep=10)
            active = data.contact.geom[data.contact.efc_address >= 0].tolist()
            pairs.update({tuple(sorted(pair)) for pair in active})
            sizes[len(active)] += 1
    total = sum(sizes.values())
    reduced = reduced_pairs(robot)
    rows = [
        {
            "pair": [names[i] for i in pair],
            "share": count / total,
            "in_reduced_model": frozenset(names[i] for i in pair) in reduced,
        }
        for pair, count in pairs.most_common()
    ]
    contacts = {str(size): sizes[size] / total for size in sorted(sizes)}
    return {"robot": robot, "steps": total, "pairs": rows, "contacts": contacts}


def reduced_pairs(robot: str) -> set[frozenset[str]]:
    """The pairs of geoms that the reduced model collides."""
    config = EnvConfig(robot=robot, hazards_num=1)  # pyright: ignore
    model = physics_model(config).mj_model
    ends = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return {frozenset((model.geom(a).name, model.geom(b).name)) for a, b in ends}


def table(robots: list[dict[str, Any]]) -> str:
    """The table of experiments/results/touches/touches.md."""
    lines = [
        "| robot | pair | share of the steps | in the reduced model |",
        "|---|---|---|---|",
    ]
    for found in robots:
        for row in found["pairs"]:
            known = "yes" if row["in_reduced_model"] else "no"
            pair = " and ".join(row["pair"])
            lines.append(
                f"| {found['robot']} | {pair} | {row['share']:.6f} | {known} |"
            )
        if not found["pairs"]:
            lines.append(f"| {found['robot']} | none | | |")
    return "\n".join(lines) + "\n"


def run(options: Options) -> None:
    """All robots, a file each."""
    options.runs.mkdir(parents=True, exist_ok=True)
    for robot in options.only or ROBOTS:
        file = options.runs / f"{robot}.json"
        if not file.exists():
            found = survey(robot, 2 * EPISODE if options.smoke else STEPS)
            file.write_text(json.dumps(found))


def collect(options: Options) -> None:
    """JSON and table."""
    files: list[Path] = [options.runs / f"{robot}.json" for robot in ROBOTS]
    robots = [json.loads(file.read_text()) for file in files if file.exists()]
    command = "python experiments/touches.py run && python experiments/touches.py "
    result = {"command": command + "collect", "facts": run_facts(), "robots": robots}
    options.results.mkdir(parents=True, exist_ok=True)
    (options.results / "touches.json").write_text(compact(result) + "\n")
    (options.results / "touches.md").write_text(table(robots))


if __name__ == "__main__":
    run_part("touches", __doc__, {"run": run, "collect": collect}, ROBOTS)
