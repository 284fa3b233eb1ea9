"""The house keeps its shape: what may import what, where jit and print may stand."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import autocost_jax

SRC = Path(autocost_jax.__file__).parent
ROOT = Path(__file__).parents[1]
MAX_FUNCTION, MAX_MODULE = 60, 350  # lines that are not docstring

# A module may import only what stands before it; `x.*` stands for all of a package
# whose members may import each other.
ORDER = (
    "records",
    "precision",
    "arrays",
    "cluster",
    "checks",
    "env_config",
    "config",
    "presets",
    "envs.*",
    "rollout",
    "costs",
    "agents.*",
    "train",
    "evaluate",
    "es",
    "success",
    "starts",
    "population",
    "stages",
    "evolution",
    "rundata",
    "checkpoints",
    "store",
    "report_assets.*",
    "report",
    "scene",
    "summary",
    "progress",
    "policies",
    "outcome",
    "picture",
    "painter",
    "gallery",
    "render",
    "finish",
    "run",
    "methods",
    "demo",
    "bench",
    "commandline",
    "evolve",
    "showing",
    "cli",
    "interop.*",
)
MAY_PRINT = {"evolve", "cli", "showing", "progress", "commandline"}
MAY_JIT = {"population", "bench"}
# Closures over one agent's configuration, read from top to bottom.
LONG_FUNCTIONS = {
    "agents.fisher.mlp_fisher_product",
    "agents.ppo_lagrangian.update_policy",
    "agents.ppo_lagrangian.ppo_lagrangian",
}

# Imported by `import autocost_jax`; everything else waits inside a function, except
# that interop.x, which nothing imports, may import x. (flax itself loads rich, yaml.)
RUNTIME = {"jax", "flax", "optax", "chex", "numpy", "mujoco", "orbax"}
LAZY = ("tyro", "matplotlib", "tensorboardX", "brax", "gymnasium")
# Import name -> the distribution that brings it, where they differ.
DISTRIBUTION = {
    "orbax": "orbax-checkpoint",
    "yaml": "pyyaml",
    "mujoco.mjx": "mujoco-mjx",
    "PIL": "pillow",
    "imageio_ffmpeg": "imageio-ffmpeg",
}


def modules() -> dict[str, ast.Module]:
    """Dotted name below the package -> syntax tree; the package itself is ""."""
    found = {}
    for path in sorted(SRC.rglob("*.py")):
        parts = path.relative_to(SRC).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        found[name] = ast.parse(path.read_text(), str(path))
    return found


MODULES = modules()
NAMES = sorted(MODULES)


def imported(tree: ast.AST) -> Iterator[str]:
    """Full dotted names of all that is imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def own_module(name: str) -> str | None:
    """The module below the package that an imported name belongs to."""
    if name.split(".")[0] != "autocost_jax":
        return None
    below = name.removeprefix("autocost_jax").removeprefix(".")
    while below and below not in MODULES:
        below = below.rpartition(".")[0]
    return below


def place(module: str) -> int:
    """Position in `ORDER`."""
    package = module.split(".")[0]
    entry = module if module in ORDER else f"{package}.*"
    return ORDER.index(entry)


def test_the_order_names_every_module():
    named = {name.removesuffix(".*") for name in ORDER}
    packages = {name.split(".")[0] for name in NAMES} - {""}
    assert packages <= named, "a new module needs its place in ORDER"
    assert len(named) == len(ORDER)


@pytest.mark.parametrize("name", [name for name in NAMES if name])
def test_imports_go_one_way(name):
    for other in map(own_module, imported(MODULES[name])):
        if other is None or other == name:
            continue
        assert other != "", f"{name} imports the package's own public names"
        same_package = place(other) == place(name)  # two modules have one place
        assert same_package or place(other) < place(name), f"{name} imports {other}"


def calls(tree: ast.AST) -> Iterator[str]:
    """Dotted names of all functions called or passed around, such as `jax.jit`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute | ast.Name):
            yield ast.unparse(node)


@pytest.mark.parametrize("name", NAMES)
def test_jit_has_one_home(name):
    used = set(calls(MODULES[name])) | set(imported(MODULES[name]))
    forbidden = {"jax.jit", "jax.pmap", "jit", "pmap", "nn.jit"}
    if name not in MAY_JIT:
        assert not used & forbidden
    chatter = {"jax.debug.print", "jax.debug.callback", "jax.debug.breakpoint"}
    assert not used & chatter


def test_jit_is_at_home():
    assert "jax.jit" in set(calls(MODULES["population"]))


@pytest.mark.parametrize("name", sorted(set(NAMES) - MAY_PRINT))
def test_libraries_are_silent(name):
    assert "print" not in set(calls(MODULES[name]))


@pytest.mark.parametrize("name", NAMES)
def test_input_is_not_checked_by_assert(name):
    """What a type checker must be told is written `assert x is not None`."""
    for node in ast.walk(MODULES[name]):
        if isinstance(node, ast.Assert):
            narrowing = ast.unparse(node.test).endswith("is not None")
            assert narrowing, f"{name}:{node.lineno}: {ast.unparse(node)}"
            assert node.msg is None


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
    long = {}
    for name, tree in MODULES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1 - docstring_lines(node)
                if lines > MAX_FUNCTION:
                    long[f"{name}.{node.name}"] = lines
    assert long.keys() <= LONG_FUNCTIONS, long


def test_modules_are_short():
    long = {}
    for name, tree in MODULES.items():
        path = SRC / (name.replace(".", "/") + ".py") if name else SRC / "__init__.py"
        if not path.exists():
            path = SRC / name.replace(".", "/") / "__init__.py"
        lines = len(path.read_text().splitlines()) - docstring_lines(tree)
        if lines > MAX_MODULE:
            long[name] = lines
    assert not long


@pytest.fixture(scope="module")
def loaded() -> set[str]:
    """Top-level packages in memory after importing the library, and all it is for."""
    code = (
        "import sys, autocost_jax, autocost_jax.population, autocost_jax.evolution\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("package", LAZY)
def test_heavy_packages_wait_for_their_use(loaded, package):
    assert package not in loaded


def test_the_library_needs_only_its_runtime(loaded):
    """Outside the functions only these packages and the standard library are named."""
    assert loaded > RUNTIME - {"orbax"}
    for name, tree in MODULES.items():
        allowed = RUNTIME | set(sys.stdlib_module_names) | {"autocost_jax"}
        if name.startswith("interop."):
            allowed |= {name.removeprefix("interop.")}
        for other in imported_at_the_top(tree):
            assert other.split(".")[0] in allowed, f"{name} imports {other} at its top"


def imported_at_the_top(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node)
        if not (for_types or isinstance(node, ast.FunctionDef | ast.ClassDef)):
            yield from imported(node)


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
    for tree in MODULES.values():
        for name in imported(tree):
            top = name.split(".")[0]
            if top in sys.stdlib_module_names or top == "autocost_jax":
                continue
            used.add(DISTRIBUTION.get(top, top))
            if name.startswith("mujoco.mjx"):
                used.add("mujoco-mjx")
    assert used <= declared | optional
    assert declared <= used, f"declared, never imported: {declared - used}"
