"""The scripts outside the package, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
# Of scripts, imported by plain name.
NEIGHBOURS = ("common", "paper", "robots_tables", "programs")


def load_script(name: str) -> ModuleType:
    """A script such as "experiments/robots"; it may import its neighbours."""
    file = ROOT / f"{name}.py"
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(file.parent))
        spec.loader.exec_module(module)
    for neighbour in NEIGHBOURS:
        sys.modules.pop(neighbour, None)
    return module
