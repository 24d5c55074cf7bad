"""What the docstrings, the README and the pages show can be run, and the README stays short."""

import ast
import doctest
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lgmdjax.paths import PACKAGE_DIR

ROOT = Path(__file__).parents[1]
MODULES = sorted(
    ".".join(("lgmdjax", *path.relative_to(PACKAGE_DIR).with_suffix("").parts)).removesuffix(".__init__")
    for path in PACKAGE_DIR.rglob("*.py")
    if path.stem != "__main__" and ">>> " in path.read_text(encoding="utf-8")
)
PAGES = sorted((ROOT / "docs").glob("*.md")) + sorted((ROOT / "docs" / "howto").glob("*.md"))


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.M | re.S)


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.usefixtures("float32")
def test_examples_of_docstrings(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0 and result.failed == 0


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 600


def test_readme_shows_files_that_are_there():
    links = re.findall(r"\]\(([^)#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert links and all((ROOT / link).exists() for link in links if "://" not in link)


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path):
    """With walks of a second instead of half a minute, in a process of its own; the smoke run has its program."""
    (program,) = python_blocks(ROOT / "README.md")
    short = program.replace("seconds=30", "seconds=1")
    assert short != program
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", short], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(r"^\d+ \[\d+, .*\]$", done.stdout, flags=re.M)  # collisions per 100 m with their interval
    assert {path.name for path in tmp_path.iterdir()} == {"walks.png", "walk.mp4"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_names_on_the_pages_exist(page):
    """Every `lj.a.b.c` and every import of the package leads to something; running them all would take minutes."""
    import lgmdjax as lj

    for block in python_blocks(page):
        if "..." in block:  # a sketch
            continue
        tree = ast.parse(block)
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("lj."):
                target = lj
                for part in ast.unparse(node).split("(")[0].split(".")[1:]:
                    target = getattr(target, part)
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("lgmdjax"):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, alias.name) for alias in node.names)


@pytest.mark.usefixtures("float32")
def test_the_detector_of_the_how_to_sees_an_approach_and_fits_into_the_robot(tmp_path, monkeypatch):
    """As a file, which the second program imports; its walk, which takes long to compile, is left out."""
    program, steering = python_blocks(ROOT / "docs" / "howto" / "detector.md")
    (tmp_path / "my_detector.py").write_text(program)
    monkeypatch.syspath_prepend(tmp_path)
    own = importlib.import_module("my_detector")
    assert own.response.u[-1] > 1.05 * own.response.u[3]
    assembled, _, walk = steering.partition("record = ")
    assert walk.startswith("lj.rollout(robot, ")
    names: dict[str, Any] = {"lj": own.lj}
    exec(compile(assembled, "detector.md", "exec"), names)
    assert names["robot"].controller.detector.model is own


@pytest.mark.usefixtures("float32")
def test_the_pendulum_of_the_how_to_is_steered_by_its_gradient():
    (program,) = python_blocks(ROOT / "docs" / "howto" / "physics.md")
    names: dict[str, Any] = {"__name__": "physics"}
    exec(compile(program, "physics.md", "exec"), names)
    assert float(names["miss"](names["torque"])) < 1e-6 < float(names["miss"](0 * names["torque"]))
