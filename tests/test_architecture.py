"""Rules of the layout, read from the source: layers, cycles, sizes, a light import, pinned dependencies."""

import ast
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxsid"

# Low to high; a module imports from its own layer or a lower one.
LAYERS = (
    "compilation",
    "parallel",
    "records",
    "checks",
    "digits",
    "least_squares",
    "mechanics",
    "examples",
    "files",
    "impulse",
    "realization",
    "modes",
    "physical",
    "uncertainty",
    "identification",
    "refinement",
    "gap",
    "pipeline",
    "study",
    "report",
    "demo",
    "cli",
)
# The reference systems judge the estimators, so they use none of them.
NARROWER = {"examples": {"examples", "records", "checks", "mechanics"}}

# Slow to load, and of no use to a user of the numerics.
HEAVY = (
    "matplotlib",
    "dask",
    "scipy",
    "pandas",
    "typer",
    "rich",
    "pydantic",
    "h5py",
    "pyuff",
    "jinja2",
    "zarr",
    "pyarrow",
    "distributed",
)
CORE = "jax, equinox, jaxtyping, optimistix, jaxopt, numpy, pywt"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
PYTHON_FILES = [
    path for folder in ("jaxsid", "tests", "benchmarks") for path in sorted((ROOT / folder).rglob("*.py"))
]


def layer(module: str) -> str:
    return module.split(".")[1] if "." in module else "jaxsid"


def imported_names(module: str) -> set[str]:
    """Dotted names that a module imports, wherever in the file, as written."""
    path, names = MODULES[module], set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def imported_modules(module: str) -> set[str]:
    """The modules of this package that a module imports."""
    ours = {name for name in imported_names(module) if name.split(".")[0] == "jaxsid"}
    return {name if name in MODULES else name.rpartition(".")[0] or name for name in ours} - {module}


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    lines = (function.end_lineno or function.lineno) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        lines -= (first.end_lineno or first.lineno) - first.lineno + 1
    return lines


def run_python(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_every_module_has_a_layer():
    unknown = {layer(module) for module in MODULES} - {"jaxsid", "__main__", *LAYERS}
    assert not unknown, f"give {unknown} a place in LAYERS"


@pytest.mark.parametrize("module", [m for m in MODULES if layer(m) in LAYERS])
def test_imports_go_down(module):
    own = layer(module)
    allowed = NARROWER.get(own, set(LAYERS[: LAYERS.index(own) + 1]))
    upward = {name for name in imported_modules(module) if layer(name) not in allowed}
    assert not upward, f"{module} imports {upward}, which is above it"


def test_no_import_cycles():
    order = list(TopologicalSorter({module: imported_modules(module) for module in MODULES}).static_order())
    assert set(order) >= set(MODULES)


@pytest.mark.parametrize("path", PYTHON_FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_are_short(path):
    assert len(path.read_text().splitlines()) <= 500


@pytest.mark.parametrize("module", MODULES)
def test_functions_are_short(module):
    tree = ast.parse(MODULES[module].read_text())
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    long = {f.name: body_lines(f) for f in functions if body_lines(f) > 60}
    assert not long, f"over 60 lines without their docstring: {long}"


def test_import_is_light():
    code = (
        f"import sys, {CORE}; before = set(sys.modules); import jaxsid; "
        f"print(*sorted(m for m in set(sys.modules) - before if m.split('.')[0] in {HEAVY}))"
    )
    assert run_python(code) == ""


def test_import_leaves_the_jax_configuration_alone():
    code = (
        "import jax; c = jax.config; before = dict(c.values); import jaxsid; print(before == dict(c.values))"
    )
    assert run_python(code) == "True"


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [
        project["dependencies"],
        *(v for k, v in project["optional-dependencies"].items() if k != "cuda"),
    ]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    pins = {name.lower().replace("_", "-"): version for name, version in pins.items()}
    for requirement in (Requirement(text) for group in groups for text in group):
        version = pins.get(requirement.name.lower().replace("_", "-"))
        assert version is not None, f"{requirement.name} is not in constraints.txt"
        assert requirement.specifier.contains(version, prereleases=True), f"{requirement} excludes {version}"
