"""The house keeps its shape; layers are in pyproject.toml, most lints in ruff's."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

import autocost_jax

SRC = Path(autocost_jax.__file__).parent
ROOT = Path(__file__).parents[1]
MAX_FUNCTION, MAX_MODULE = 60, 350  # lines that are not docstring
# Closures over one agent's configuration, read from top to bottom.
LONG_FUNCTIONS = {
    "agents/fisher.py:mlp_fisher_product",
    "agents/first_order.py:take_passes",
    "agents/first_order.py:first_order_agent",
}
# All that modules may import at their top, beside the standard library.
RUNTIME = {"jax", "flax", "optax", "chex", "numpy", "mujoco", "orbax", "autocost_jax"}
# Loaded by the functions that use them; flax itself loads rich and yaml.
LAZY = {"tyro", "matplotlib", "tensorboardX", "brax", "gymnasium"}
# Import name -> the distribution that brings it, where they differ.
DISTRIBUTION = {
    "orbax": "orbax-checkpoint",
    "yaml": "pyyaml",
    "PIL": "pillow",
    "imageio_ffmpeg": "imageio-ffmpeg",
}


def trees() -> dict[str, ast.Module]:
    """Path below the package -> syntax tree."""
    return {
        str(path.relative_to(SRC)): ast.parse(path.read_text(), str(path))
        for path in sorted(SRC.rglob("*.py"))
    }


def imported(tree: ast.AST) -> Iterator[str]:
    """Full dotted names of all that is imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def test_imports_go_downwards(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports(no_cache=True) == EXIT_STATUS_SUCCESS


def docstring_lines(tree: ast.AST) -> int:
    total = 0
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            total += (text.end_lineno or text.lineno) - text.lineno + 1
    return total


def test_functions_are_short():
    long = set()
    for name, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1 - docstring_lines(node)
                if lines > MAX_FUNCTION:
                    long.add(f"{name}:{node.name}")
    assert long <= LONG_FUNCTIONS


def test_modules_are_short():
    sizes = {
        name: len((SRC / name).read_text().splitlines()) - docstring_lines(tree)
        for name, tree in trees().items()
    }
    assert not {name: size for name, size in sizes.items() if size > MAX_MODULE}


def test_the_library_needs_only_its_runtime():
    """Nor does a module import the package's own public names."""
    for name, tree in trees().items():
        allowed = RUNTIME | set(sys.stdlib_module_names)
        if name.startswith("interop/"):
            allowed |= {Path(name).stem}
        for node in tree.body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                tops = {other.split(".")[0] for other in imported(node)}
                assert tops <= allowed, f"{name} imports {tops - allowed} at its top"
        for other in imported(tree):
            place = SRC.parent / other.replace(".", "/")
            is_module = place.is_dir() or place.with_suffix(".py").exists()
            is_public = other.startswith("autocost_jax.") and other.count(".") == 1
            assert is_module or not is_public, f"{name} imports {other}"


def test_heavy_packages_wait_for_their_use():
    code = (
        "import sys, autocost_jax, autocost_jax.population\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert "jax" in loaded
    assert not loaded & LAZY


def test_dependencies_are_the_packages_imported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

    def bare(requirement: str) -> str:
        return requirement.split(">")[0].split("<")[0].split("[")[0].strip()

    declared = {bare(text) for text in project["dependencies"]}
    optional = {
        bare(text)
        for texts in project.get("optional-dependencies", {}).values()
        for text in texts
    }
    used = set()
    for tree in trees().values():
        for name in imported(tree):
            top = name.split(".")[0]
            if top in sys.stdlib_module_names or top == "autocost_jax":
                continue
            used.add(DISTRIBUTION.get(top, top))
            if name.startswith("mujoco.mjx"):
                used.add("mujoco-mjx")
    assert used <= declared | optional
    assert declared <= used, f"declared, never imported: {declared - used}"
