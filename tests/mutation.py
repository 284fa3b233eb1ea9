"""Do the tests notice faults? Made by hand, one at a time (data/faults.json).

    python tests/mutation.py [--only PART ...] [--new]  # tests/results/mutation.json

Each fault changes one line of a copy of the source: a sign, an index, an order, a
dropped weight. The tests of that part of the code must then fail. Takes about half an
hour on two cores; not part of the test run.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "tests" / "results" / "mutation.json"
SOURCE = "src/autocost_jax"


class Fault(NamedTuple):
    """One changed line.

    Attributes:
      file: below the package.
      old: text that stands in the file once.
      new: what takes its place.
    """

    file: str
    old: str
    new: str


# Tests that must notice a fault in these files, cheapest first.
TESTS = {
    "es.py": ["test_es.py"],
    "agents/advantages.py": ["agents/test_advantages.py"],
    "agents/ppo_lagrangian.py": ["agents/test_ppo_lagrangian.py"],
    "agents/first_order.py": ["agents/test_ppo_lagrangian.py"],
    "agents/focops.py": ["agents/test_focops.py"],
    "agents/pid_lagrangian.py": ["agents/test_pid_lagrangian.py"],
    "agents/cpo.py": ["agents/test_cpo.py"],
    "agents/trust_region.py": ["agents/test_trust_region.py"],
    "agents/fisher.py": ["agents/test_trust_region.py"],
    "agents/normalizer.py": ["agents/test_normalizer.py"],
    "agents/base.py": ["agents/test_agents.py"],
    "envs/sensors.py": ["envs/test_sensors.py"],
    "envs/tasks.py": ["envs/test_tasks.py"],
    "envs/constraints.py": ["envs/test_tasks.py", "envs/test_env.py"],
    "envs/layout.py": ["envs/test_layout.py", "envs/test_placement.py"],
    "envs/physics/closed_form.py": ["envs/test_closed_form.py"],
    "envs/env.py": ["envs/test_env.py"],
    "train.py": ["test_train.py"],
    "metrics.py": ["test_train.py"],
    "costs.py": ["test_costs.py"],
    "rollout.py": ["test_rollout.py"],
    "evaluate.py": ["test_evaluate.py"],
    "population.py": ["test_population.py"],
    "search": ["test_success.py", "test_es.py", "test_evolution.py"],
    "runs": ["test_outcome.py", "test_store.py"],
}
FAULTS = [
    Fault(**row)
    for row in json.loads((ROOT / "tests" / "data" / "faults.json").read_text())
]


def tests_of(file: str) -> list[str]:
    """The test files of a source file."""
    return TESTS.get(file) or TESTS[file.split("/")[0]]


def is_noticed(fault: Fault, folder: Path) -> bool:
    """Whether a test fails once the fault is in a copy of the source.

    Raises:
      ValueError: the fault's text does not stand in the file exactly once.
    """
    copy = folder / "src"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(ROOT / "src", copy)
    path = copy / "autocost_jax" / fault.file
    text = path.read_text()
    if text.count(fault.old) != 1:
        raise ValueError(f"{fault.file} has {text.count(fault.old)} x {fault.old!r}")
    path.write_text(text.replace(fault.old, fault.new))
    env = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    for tests in tests_of(fault.file):
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-x",
            "-n",
            "0",
            f"tests/{tests}",
        ]
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True)
        if done.returncode == 1:
            return True
        if done.returncode != 0:
            raise ValueError(
                f"pytest ended with {done.returncode}: {done.stdout[-500:]}"
            )
    return False


def main() -> None:
    """Every fault, or those of some parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", help="files below the package")
    parser.add_argument("--new", action="store_true", help="those never tried")
    args = parser.parse_args()
    known = json.loads(RESULT.read_text())["faults"] if RESULT.exists() else []
    rows = {tuple(row[name] for name in Fault._fields): row for row in known}
    with tempfile.TemporaryDirectory() as folder:
        for fault in FAULTS:
            is_other = args.only and fault.file not in args.only
            if is_other or (args.new and tuple(fault) in rows):
                continue
            row = fault._asdict() | {"noticed": is_noticed(fault, Path(folder))}
            rows[tuple(fault)] = row
            print("noticed" if row["noticed"] else "MISSED ", *fault, flush=True)
            kept = [rows[tuple(one)] for one in FAULTS if tuple(one) in rows]
            noticed = sum(row["noticed"] for row in kept)
            result = {
                "command": "python tests/mutation.py",
                "noticed": noticed,
                "of": len(kept),
                "faults": kept,
            }
            RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
