"""Sphinx: pages in MyST, notebooks as they are committed, reference from docstrings."""

import re
from functools import partial

import lgmdjax

project, author, release = "lgmdjax", "The lgmdjax authors", lgmdjax.__version__
copyright = author

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
templates_path = ["_templates"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the notebooks carry their outputs, which a test keeps true

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes stand in the source and in the docstrings
autodoc_default_options = {"members": True, "undoc-members": True, "exclude-members": "Context"}  # MJX's own class
napoleon_google_docstring = True
add_module_names = False

html_theme = "pydata_sphinx_theme"
html_title = "lgmdjax"
html_static_path = ["_static"]
html_theme_options = {
    "header_links_before_dropdown": 8,
    "show_prev_next": False,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
}
html_show_sourcelink = False


def _to_rst(app, what, name, obj, options, lines: list[str]) -> None:
    """Turn a docstring's Markdown (code spans, fenced code, tables) into reStructuredText, in place."""
    lines[:] = _convert("\n".join(lines)).split("\n")


def _convert(text: str) -> str:
    """Convert block by block: fenced code, tables, doctests, and prose."""
    blocks = re.split(
        r"(^ *```\w*\n.*?^ *```$|(?:^ *\|[^\n]*\n?)+|(?:^ *(?:>>>|\.\.\.)[^\n]*\n?)+)", text, flags=re.M | re.S
    )
    return "".join(_block(block) for block in blocks)


def _block(block: str) -> str:
    start = block.lstrip()
    if start.startswith("```"):
        indent = block[: len(block) - len(start)]
        code = block.split("\n")[1:-1]
        return "\n".join([f"{indent}.. code-block:: python", "", *(f"    {line}" for line in code), ""])
    if start.startswith("|"):
        return _table(block.rstrip("\n").split("\n"))
    return block if start.startswith(">>>") else _spans(block)


def _spans(text: str) -> str:
    """Double the backticks of code spans; keep bars, stars and trailing underscores from being markup."""
    parts = re.split(r"(`[^`]+`)", text)
    escape = partial(re.sub, r"([|*]|(?<=\w)_(?!\w))", r"\\\1")
    return "".join(f"`{part}`" if part.startswith("`") else escape(part) for part in parts)


def _table(rows: list[str]) -> str:
    indent = " " * (len(rows[0]) - len(rows[0].lstrip()))
    cells = [[_spans(cell.strip()) for cell in re.split(r"(?<=\s)\|(?=\s)", f" {row.strip()} ")[1:-1]] for row in rows]
    cells = [[f"\\{cell}" if cell in ("-", "+") else cell for cell in row] for row in cells]  # no list in the list
    body = [row for row in cells if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    lines = ["", f"{indent}.. list-table::", f"{indent}   :header-rows: 1", ""]
    for row in body:
        lines += [f"{indent}   {'* -' if not k else '  -'} {cell}" for k, cell in enumerate(row)]
    return "\n".join([*lines, "", ""])


def setup(app) -> None:
    """Convert docstrings before napoleon reads their sections."""
    app.connect("autodoc-process-docstring", _to_rst, priority=400)
