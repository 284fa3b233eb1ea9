"""Other projects and this one, measured in turns in one run.

    python benchmarks/peers.py                       # all peers
    python benchmarks/peers.py --only crax_bench

Each peer gets a virtual environment of its own under benchmarks/.venv/, made at the
first call from PyPI; Safety-Gymnasium and omnisafe need a python3.10 on the path,
mjx-safety-gym and crax-bench a python3.11. A peer that cannot be installed or run gets
a row that says why. Writes benchmarks/results/peers.json and the table of it; `--only`
renews the rows of some peers.
"""

import argparse
import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from autocost_jax import env_config
from autocost_jax.bench import Speed, env_speed, slot_speeds
from autocost_jax.commandline import use_devices
from autocost_jax.config import AgentConfig, Algorithm, TrainConfig
from autocost_jax.runs.directory import run_facts

HERE = Path(__file__).parent
BATCH, SLOTS = 1024, 8
OMNISAFE_STEPS = 4000


class Peer(NamedTuple):
    """Another project.

    Attributes:
      python: the interpreter it needs.
      installs: arguments of pip, one call each.
    """

    python: str
    installs: tuple[tuple[str, ...], ...]


class Case(NamedTuple):
    """Something that a peer and this project both do.

    Attributes:
      peer: a key of `PEERS`.
      arguments: of the peer's script.
      world: the nearest world here.
      physics: of it.
      train: None for env steps; else the algorithm to train with and its passes.
    """

    peer: str
    arguments: tuple[str, ...]
    world: str
    physics: str = "reduced"
    train: tuple[Algorithm, int] | None = None


PEERS = {
    "safety_gymnasium": Peer("python3.10", (("safety-gymnasium==1.0.0",),)),
    "mjx_safety_gym": Peer("python3.11", (("mjx-safety-gym==0.1.6",),)),
    "crax_bench": Peer("python3.11", (("crax-bench==0.1.0",),)),
    "omnisafe": Peer(
        "python3.10",
        (
            ("torch==1.12.1", "omnisafe==0.5.0", "safety-gymnasium==1.0.0"),
            ("numpy==1.26.4",),
        ),
    ),
}
CASES = (
    Case("safety_gymnasium", ("SafetyPointGoal1-v0",), "Goal-Hazard-Point"),
    Case(
        "safety_gymnasium", ("SafetyPointGoal1-v0",), "Goal-Hazard-Point", "closed_form"
    ),
    Case("safety_gymnasium", ("SafetyPointGoal1-v0",), "Goal-Pillar-Point"),
    Case("safety_gymnasium", ("SafetyPointPush1-v0",), "Push-Hazard-Point"),
    Case("safety_gymnasium", ("SafetyCarGoal1-v0",), "Goal-Hazard-Car"),
    Case("safety_gymnasium", ("SafetyDoggoGoal1-v0",), "Goal-Hazard-Doggo"),
    Case("mjx_safety_gym", (str(BATCH),), "Goal-Hazard-Point"),
    Case("crax_bench", (str(BATCH),), "Goal-Hazard-Point"),
    Case(
        "omnisafe",
        ("PPOLag", "6", str(OMNISAFE_STEPS)),
        "Goal-Hazard-Point",
        train=("ppo_lagrangian", 6),
    ),
    Case(
        "omnisafe",
        ("CPO", "10", str(OMNISAFE_STEPS)),
        "Goal-Hazard-Point",
        train=("cpo", 10),
    ),
)


class PeerError(Exception):
    """A peer could not be installed or run; the message says why."""


def install(name: str) -> Path:
    """The interpreter of a peer's virtual environment, made if it is not there.

    Raises:
      PeerError: without the interpreter it needs, or if pip fails.
    """
    peer, folder = PEERS[name], HERE / ".venv" / name
    python = folder / "bin" / "python"
    if (folder / "installed").exists():
        return python
    base = shutil.which(peer.python)
    if base is None:
        raise PeerError(f"no {peer.python} on the path")
    folder.parent.mkdir(exist_ok=True)
    call([base, "-m", "venv", "--clear", str(folder)])
    for packages in peer.installs:
        call([str(python), "-m", "pip", "install", "-q", *packages])
    (folder / "installed").touch()
    return python


def call(command: Sequence[str]) -> str:
    """What a command prints.

    Raises:
      PeerError: with its last line of errors, if it fails or takes 20 minutes.
    """
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=1200,
            check=False,
            cwd=HERE / ".venv",  # some write logs where they are
        )
    except subprocess.TimeoutExpired as error:
        raise PeerError("took more than 20 minutes") from error
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise PeerError(lines[-1] if lines else f"exit status {done.returncode}")
    return done.stdout


def measure_peer(case: Case) -> dict[str, Any]:
    """The last line that the peer's script prints."""
    python = install(case.peer).absolute()
    script = HERE.absolute() / "peers" / f"run_{case.peer}.py"
    return json.loads(
        call([str(python), str(script), *case.arguments]).splitlines()[-1]
    )


def measure_ours(case: Case, devices: Sequence[Any]) -> Speed:
    """This project at the same thing."""
    env: Any = dataclasses.replace(env_config(case.world), physics=case.physics)
    if case.train is None:
        return env_speed(env, BATCH, devices)
    algorithm, passes = case.train
    agent = AgentConfig(
        hidden_sizes=(64, 64),
        policy_passes=6,
        policy_minibatches=8,
        value_passes=passes,
        value_minibatches=8,
    )
    train = TrainConfig(env=env, agent=agent, num_worlds=8)
    return slot_speeds(train, algorithm, (SLOTS,), devices)[0]


def render(result: dict[str, Any]) -> str:
    """The table of docs/performance.md."""
    lines = [
        "| peer | env steps/s | here | env steps/s | ratio |",
        "|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        task = row["arguments"][0] if row["arguments"][0] != str(BATCH) else ""
        peer = f"{row['peer'].replace('_', '-')} {task}".strip()
        here = row["world"] + (", closed form" * (row["physics"] == "closed_form"))
        if row["train"]:
            here = f"{row['train'][0].replace('_', '-')}, {SLOTS} slots, {here}"
        theirs = row["peer_rate"]
        cells = [
            peer,
            f"{theirs:,}" if theirs else f"not measured: {row['why']}",
            here,
            f"{row['rate']:,}",
            f"{row['rate'] / theirs:,.1f} x" if theirs else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def key(row: dict[str, Any]) -> str:
    """Which case a row is of."""
    return json.dumps([row[name] for name in Case._fields])


def main() -> None:
    """Measure, print rows, write JSON and table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=PEERS, default=tuple(PEERS))
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder")
    options = parser.parse_args()
    devices = use_devices(None)
    file = options.out / "peers.json"
    old = json.loads(file.read_text())["rows"] if file.exists() else []
    rows = {key(row): row for row in old}
    facts = run_facts()
    facts.pop("seed")
    stamp = {
        "command": " ".join(["python benchmarks/peers.py", *sys.argv[1:]]),
        "facts": facts,
        "devices": len(devices),
    }
    for case in (case for case in CASES if case.peer in options.only):
        theirs, why = None, None
        try:
            theirs = measure_peer(case)["env_steps_per_second"]
        except PeerError as error:
            why = str(error)
        rate = measure_ours(case, devices).env_steps_per_second
        row = {**case._asdict(), "peer_rate": theirs, "why": why, "rate": rate}
        print(json.dumps(row), flush=True)
        rows[key(row)] = row | stamp
        known = [key(case._asdict()) for case in CASES]
        result = {"rows": [rows[name] for name in known if name in rows]}
        file.write_text(json.dumps(result, indent=1) + "\n")
        file.with_suffix(".md").write_text(render(result))


if __name__ == "__main__":
    main()
