"""What all tests share: the CPU, one key, one compilation of equal programs."""

import os

import jax
import pytest


def pytest_configure(config: pytest.Config) -> None:
    """The plain run is on the CPU; `-m gpu` takes what there is."""
    if config.getoption("markexpr", "") != "gpu":
        jax.config.update("jax_platforms", "cpu")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")


@pytest.fixture(scope="session", autouse=True)
def compilation_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Programs that two tests have in common are compiled once a session."""
    path = tmp_path_factory.getbasetemp() / "jax_cache"
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(0)
