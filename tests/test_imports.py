"""The wings stand in one order, and imports run down it: no circle, no import by string, none inside a function."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from lgmdjax.paths import PACKAGE

WINGS = (
    "cli",
    "pipeline",
    "studies",
    "learning",
    "evaluation",
    "reporting",
    "simulation",
    "control",
    "detectors",
    "sensors",
    "body",
    "world",
    "locomotion",
    "runtime",
    "",  # the ground: modules beside the wings
)
ENTRANCES = ("lgmdjax", "lgmdjax.__main__")  # they stand above the wings
# JAX reads its variables when it is imported: the command line sets them first, and imports it after.
LATE = ("lgmdjax.cli.", "lgmdjax.runtime.jax_setup")

MODULES = {
    ".".join(("lgmdjax", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


def wing(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 2 or (PACKAGE / parts[-1]).is_dir() else ""


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write imports in full"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else str(node.module) for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & MODULES.keys()


def test_every_wing_is_listed():
    folders = {path.parent.relative_to(PACKAGE).parts[0] for path in PACKAGE.glob("*/__init__.py")}
    assert folders == set(WINGS) - {""}


@pytest.mark.parametrize("module", sorted(set(MODULES) - set(ENTRANCES)))
def test_imports_run_down(module):
    own = WINGS.index(wing(module))
    for other in imported(MODULES[module]) - {"lgmdjax"}:  # which has the version alone
        assert WINGS.index(wing(other)) >= own, f"{module} is below {other}"


def test_there_is_no_circle():
    graph = {module: imported(path) - {"lgmdjax"} for module, path in MODULES.items()}
    list(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_stand_at_the_top(module):
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            assert name.split(".")[-1] not in ("import_module", "__import__"), f"{module}: import by name"
        elif isinstance(node, (ast.Import, ast.ImportFrom)) and node.col_offset:
            assert module.startswith(LATE), f"{module}:{node.lineno} imports inside a function"
