"""Execute the notebooks and store their outputs in a form that changes little from run to run.

    python notebooks/execute.py                 # all notebooks
    python notebooks/execute.py 02_looming      # those named

Pictures are small PNGs with a palette. Messages on stderr, progress bars, times, versions and text representations of
pictures and tables are left out.
"""

import base64
import io
import os
import re
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).parent
TIMEOUT = 600  # s, of one cell
DPI = 75  # of pictures
COLOURS = 256  # of a picture
DROPPED_LINES = re.compile(r".*: compiling the simulation, then .*\n?")  # of stdout


def execute(path: Path) -> NotebookNode:
    """Execute a notebook in a new kernel and return it with normalised outputs; the file is not changed."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        style = Path(folder, "matplotlibrc")
        style.write_text(f"figure.dpi: {DPI}\n")
        environment = {
            **os.environ,
            "MATPLOTLIBRC": str(style),
            "MPLBACKEND": "module://matplotlib_inline.backend_inline",  # as Jupyter has it
        }
        client = NotebookClient(
            notebook,
            timeout=TIMEOUT,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": str(path.parent)}},
        )
        client.execute(env=environment)
    return normalise(notebook)


def normalise(notebook: NotebookNode) -> NotebookNode:
    """Remove what differs between runs and machines, and reduce pictures; in place."""
    notebook.metadata.language_info = {"name": "python"}
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [kept for output in cell.outputs if (kept := _normalise_output(output)) is not None]
            cell.metadata.pop("execution", None)
    return notebook


def _normalise_output(output: NotebookNode) -> NotebookNode | None:
    """Return an output in normal form, or None if it is left out."""
    if output.output_type == "stream":
        output.text = DROPPED_LINES.sub("", output.text)
        return output if output.name == "stdout" and output.text.strip() else None
    if "text/html" in output.get("data", {}):
        output.data = {"text/html": output.data["text/html"]}
    if "image/png" in output.get("data", {}):
        output.data = {"image/png": _reduce_picture(output.data["image/png"])}
        output.metadata = {}
    return output


def _reduce_picture(png: str) -> str:
    """Return a PNG in base64 with `COLOURS` colours and without metadata; a picture with a palette stays as it is."""
    picture = Image.open(io.BytesIO(base64.b64decode(png)))
    if picture.mode == "P":
        return png
    buffer = io.BytesIO()
    # Maximum coverage keeps the colours of thin lines, which the default, median cut, merges with their neighbours.
    method, dither = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE
    picture.convert("RGB").quantize(COLOURS, method, dither=dither).save(buffer, format="png", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode() + "\n"


def main(names: list[str]) -> None:
    """Execute the named notebooks, or all, and write their outputs into the files."""
    paths = [FOLDER / f"{Path(name).stem}.ipynb" for name in names] or sorted(FOLDER.glob("*.ipynb"))
    for path in paths:
        notebook = execute(path)
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
