"""The committed outputs of the notebooks are those that executing them gives.

Each notebook runs in a kernel of its own, in the precision that it sets, as a user runs it. Numbers in texts are
compared within `RELATIVE` and `ABSOLUTE`. Cells with the tag `chaotic` show numbers of long walks. Contacts amplify
rounding errors, so that another machine or version of XLA gives another walk. Of these cells only the text around the
numbers is compared. Of pictures, number and kind are compared.
"""

import importlib.util
import re
from pathlib import Path

import nbformat
import pytest
from nbformat import NotebookNode

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
EXTENDED = ("04", "05", "06", "07", "08", "09")  # take minutes each
MAX_BYTES = 2**20  # of all notebooks together
RELATIVE, ABSOLUTE = 1e-2, 1e-3
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")

_spec = importlib.util.spec_from_file_location("execute", FOLDER / "execute.py")
assert _spec is not None and _spec.loader is not None
execute = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(execute)


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def kinds(cell: NotebookNode) -> list[tuple[str, ...]]:
    """Return the kind of each output: its type, and its stream or media types."""
    return [
        (output.output_type, *([output.name] if output.output_type == "stream" else sorted(output.data)))
        for output in cell.outputs
    ]


def text(cell: NotebookNode) -> str:
    """Return all that a cell prints or shows as text."""
    shown = [output.get("data", {}) for output in cell.outputs]
    tables = [data.get("text/html") or data.get("text/plain", "") for data in shown]
    return "\n".join(output.get("text") or table for output, table in zip(cell.outputs, tables, strict=True))


def test_normalisation_keeps_results_and_drops_the_rest():
    messages = "learned, 1 to 4 of 4: compiling the simulation, then 4 robots for 30 s each\nresult: 1\n"
    cell = nbformat.v4.new_code_cell(
        metadata={"execution": {"iopub.status.busy": "2000-01-01"}, "tags": ["chaotic"]},
        outputs=[
            nbformat.v4.new_output("stream", name="stdout", text=messages),
            nbformat.v4.new_output("stream", name="stderr", text="10 %"),
        ],
    )
    notebook = execute.normalise(nbformat.v4.new_notebook(cells=[cell]))
    assert cell.metadata == {"tags": ["chaotic"]}
    assert [output.text for output in cell.outputs] == ["result: 1\n"]
    assert notebook.metadata.language_info == {"name": "python"}


def test_notebooks_are_small():
    assert sum(path.stat().st_size for path in NOTEBOOKS) < MAX_BYTES


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_committed_in_normal_form(path):
    """It begins with the front door, has outputs, and nothing in it depends on time, machine or versions."""
    notebook = nbformat.read(path, as_version=4)
    cells = code_cells(notebook)
    assert re.search(r"^import lgmdjax as lj$", cells[0].source, re.MULTILINE)
    assert sum("image/png" in output.get("data", {}) for cell in cells for output in cell.outputs) >= 3
    assert not any("stderr" in kind or "error" in kind for cell in cells for kind in kinds(cell))
    assert not any(str(folder) in path.read_text() for folder in (FOLDER.parent, Path.home()))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert notebook == execute.normalise(nbformat.read(path, as_version=4))


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [pytest.param(p, id=p.stem, marks=[pytest.mark.extended] if p.stem[:2] in EXTENDED else []) for p in NOTEBOOKS],
)
def test_notebook_gives_the_committed_outputs(path):
    """With the flags of conftest.py, with which other tests have compiled the rollout."""
    committed, executed = code_cells(nbformat.read(path, as_version=4)), code_cells(execute.execute(path))
    for expected, found in zip(committed, executed, strict=True):
        assert kinds(found) == kinds(expected), expected.source
        assert NUMBER.sub("#", text(found)).split() == NUMBER.sub("#", text(expected)).split(), expected.source
        if "chaotic" not in expected.metadata.get("tags", []):
            numbers = [[float(x) for x in NUMBER.findall(text(cell))] for cell in (found, expected)]
            assert numbers[0] == pytest.approx(numbers[1], rel=RELATIVE, abs=ABSOLUTE), expected.source
