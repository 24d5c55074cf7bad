"""The page of `lgmdjax bench clips`: one self-contained HTML file with tables, ROC, and the traces of every clip."""

import base64
import math
from collections.abc import Mapping

import jinja2

from lgmdjax.paths import PACKAGE_DIR


def render_page(contents: Mapping[str, object]) -> str:
    """Return the page; contents are the variables of the template, and every text in them is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PACKAGE_DIR / "reporting" / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["fixed"] = _fixed
    return environment.get_template("clips.html.j2").render(contents)


def inline_png(content: bytes) -> str:
    """Return a picture as a data address."""
    return f"data:image/png;base64,{base64.b64encode(content).decode()}"


def _fixed(value: float | None, decimals: int) -> str:
    """Format a number with some decimals; a dash if there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"
