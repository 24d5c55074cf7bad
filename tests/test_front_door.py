"""`import lgmdjax as lj`: what it offers, that it is lazy, and that editors and type checkers see the same."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from test_imports import WINGS

import lgmdjax as lj
from lgmdjax.paths import PACKAGE_DIR

FUNCTIONS = {
    "load_robot", "random_rooms", "rollout", "run_trial", "score", "plot_walks", "write_video", "show_walk", "walk_page"
}  # fmt: skip
TYPES = {"Record", "Room", "InputError"}
COMPONENTS = {"lgmd", "cpg", "camera", "laser", "navigator", "braitenberg", "hexapod"}


def test_dir_lists_what_a_user_needs_and_nothing_else():
    assert set(dir(lj)) == FUNCTIONS | TYPES | COMPONENTS | set(WINGS) - {""}


def test_every_name_is_what_it_says():
    assert all(callable(getattr(lj, name)) for name in FUNCTIONS)
    assert all(isinstance(getattr(lj, name), type) for name in TYPES)
    for name in COMPONENTS - {"hexapod", "laser", "camera"}:
        assert {"Params", "State", "init", "step"} <= set(vars(getattr(lj, name)))
    for name in FUNCTIONS | TYPES:
        assert getattr(lj, name).__doc__


FOLDERS = sorted(path.parent for path in PACKAGE_DIR.rglob("__init__.py"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_stub_lists_every_module_of_its_folder(folder):
    """So that tab completion and type checkers find them; the front door lists its wings and names."""
    listed = {
        alias.name
        for node in ast.walk(ast.parse((folder / "__init__.pyi").read_text()))
        if isinstance(node, ast.ImportFrom) and node.module is None
        for alias in node.names
    }
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    folders = {path.parent.name for path in folder.glob("*/__init__.py")}
    assert listed == (folders if folder == PACKAGE_DIR else modules | folders)
    package = importlib.import_module(".".join(("lgmdjax", *folder.relative_to(PACKAGE_DIR).parts)))
    assert listed <= set(dir(package))


def test_the_import_loads_nothing_heavy():
    program = "import sys, lgmdjax; print(sorted({'jax', 'mujoco', 'numpy', 'matplotlib'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert out == "[]\n"


SCRIPT = """
from pathlib import Path

import jax
import lgmdjax as lj

robot = lj.load_robot()
rooms = lj.random_rooms(jax.random.key(0), 4)
record = lj.rollout(robot, rooms, seconds=30)
reveal_type(record)
reveal_type(lj.score(record).per_100_m.value)
lj.plot_walks(record, rooms).savefig("walks.png")
lj.write_video("walk.mp4", record, rooms, robot=robot)
folder: Path = lj.run_trial("tube", seeds=1)
state = lj.lgmd.init(lj.lgmd.Params(), jax.numpy.zeros((60, 80)))
room = lj.world.scenes.testing_room()
lj.rolout
lj.run_trial("tubes")
"""


def test_pyright_knows_a_users_script(tmp_path: Path):
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "script.py"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    assert 'Type of "record" is "Record"' in found
    assert 'Type of "lj.score(record).per_100_m.value" is "float"' in found
    errors = [line for line in found.splitlines() if " - error: " in line]
    assert len(errors) == 2, found  # the misspelt name and the misspelt trial
    assert '"rolout" is not a known attribute' in errors[0] and "tubes" in errors[1]
