"""What all tests share: the CPU, one key, one compilation of equal programs."""

import json
import os
from pathlib import Path

import jax
import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--results FILE` keeps what a slow run found; see tests/results/."""
    parser.addoption("--results", type=Path, help="write outcomes and facts as JSON")


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Write the JSON of `--results`."""
    file = config.getoption("--results")
    if file is None:
        return
    from autocost_jax.runs.directory import run_facts

    reports = [
        report
        for outcome in ("passed", "failed", "skipped", "error")
        for report in terminalreporter.stats.get(outcome, [])
    ]
    result = {
        "command": f"pytest -m {config.getoption('markexpr')!r} --results {file}",
        "facts": run_facts(),
        "tests": {
            report.nodeid: {
                "outcome": report.outcome,
                "seconds": report.duration,
                **dict(report.user_properties),  # what `record_property` was told
            }
            for report in reports
        },
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(result, indent=1) + "\n")


# Programs of fast tests run once or twice: to compile them takes the time. Fusions as
# XLA made them before compile four times as fast; one piece takes a tenth less than
# pieces for many threads, which the workers leave nothing to run on.
FAST_TO_COMPILE = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)


# They come first, so that no worker waits for another at the end.
LONGEST = (
    "test_evolve.py",
    "test_stock.py",
    "test_evolution.py",
    "test_contacts.py",
    "test_population.py",
    "test_robots.py",
    "test_cli.py",
    "test_world.py",
    "test_readme.py",
    "test_demo.py",
    "test_train.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; the order within a file stays."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def is_fast(config: pytest.Config) -> bool:
    """Whether this is a run of the fast tests; slow ones compile as users do."""
    return "not slow" in str(config.getoption("markexpr"))


def pytest_configure(config: pytest.Config) -> None:
    """The plain run is on the CPU; `-m gpu` takes what there is."""
    if config.getoption("markexpr", "") != "gpu":
        jax.config.update("jax_platforms", "cpu")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    if is_fast(config):
        flags = os.environ.get("XLA_FLAGS", "")
        if FAST_TO_COMPILE not in flags:  # a worker has those of its parent
            os.environ["XLA_FLAGS"] = f"{flags} {FAST_TO_COMPILE}".strip()


@pytest.fixture(scope="session", autouse=True)
def compilation_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Programs that two tests have in common are compiled once for all workers.

    Where JAX_COMPILATION_CACHE_DIR is set, they are kept there for the next run too.
    """
    worker = "PYTEST_XDIST_WORKER" in os.environ  # its base is a folder of the run's
    base = tmp_path_factory.getbasetemp()
    run = base.parent if worker else base
    path = os.environ.get("JAX_COMPILATION_CACHE_DIR") or run / "jax_cache"
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(path)  # for command lines under test
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(scope="module", autouse=True)
def optimisation(request: pytest.FixtureRequest) -> None:
    """Fast tests compile without LLVM's optimisations, which takes half the time.

    A module whose programs run for longer says `pytestmark = pytest.mark.optimised`.
    """
    asked = request.node.get_closest_marker("optimised") is not None
    plain = is_fast(request.config) and not asked
    jax.config.update("jax_disable_most_optimizations", plain)


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)
