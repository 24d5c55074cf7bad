"""Imports run down the list of wings: no cycles, no import by string, none inside a function."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from lgmdjax.paths import PACKAGE_DIR

WINGS = (
    "cli",
    "viewer",
    "sweeps",
    "pipeline",
    "studies",
    "bench",
    "datasets",
    "learning",
    "environments",
    "evaluation",
    "hardware",
    "reporting",
    "transfer",
    "deployment",
    "simulation",
    "control",
    "detectors",
    "sensors",
    "body",
    "world",
    "locomotion",
    "runtime",
    "",  # the ground floor: modules outside of the wings
)
ENTRANCES = ("lgmdjax", "lgmdjax.__main__")  # may import from any wing
# JAX reads environment variables when it is imported. The command line sets them first, so it imports JAX late.
LATE = ("lgmdjax.cli.",)

MODULES = {
    ".".join(("lgmdjax", *path.relative_to(PACKAGE_DIR).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE_DIR.rglob("*.py"))
}


def wing(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 2 or (PACKAGE_DIR / parts[-1]).is_dir() else ""


def imported(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, at the top or inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write imports in full"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else str(node.module) for name in names}
            others = names - MODULES.keys() - {"lgmdjax.__version__"}
            assert node.module != "lgmdjax" or not others, f"{path}: import {others} from where they are defined"
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
            assert "lgmdjax" not in found, f"{path}: import a module of lgmdjax, not its front door"
    return found & MODULES.keys()


def test_every_wing_is_listed():
    folders = {path.parent.relative_to(PACKAGE_DIR).parts[0] for path in PACKAGE_DIR.glob("*/__init__.py")}
    assert folders == set(WINGS) - {""}


@pytest.mark.parametrize("module", sorted(set(MODULES) - set(ENTRANCES)))
def test_imports_run_down(module):
    own = WINGS.index(wing(module))
    for other in imported(MODULES[module]) - {"lgmdjax"}:
        assert WINGS.index(wing(other)) >= own, f"{module} may not import {other}, which is above it"


def test_there_is_no_cycle():
    graph = {module: imported(path) - {"lgmdjax"} for module, path in MODULES.items()}
    list(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("module", sorted(MODULES))
def test_nothing_is_imported_by_name_or_inside_a_function(module):
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    calls = {ast.unparse(node.func).split(".")[-1] for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert not calls & {"import_module", "__import__"}
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    late = [
        node for function in functions for node in ast.walk(function) if isinstance(node, (ast.Import, ast.ImportFrom))
    ]
    assert not late or module.startswith(LATE)
