"""Parts that HTML pages share: a template environment that escapes all text, formats of numbers, embedded files."""

import base64
import math
from pathlib import Path

import jinja2

MINUS = "\N{MINUS SIGN}"


def environment(folder: Path) -> jinja2.Environment:
    """Return the environment of the templates in a folder; a missing variable is an error. Filter: `fixed`."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["fixed"] = fixed
    return made


def fixed(value: float | None, decimals: int) -> str:
    """Format a number with some decimals; a dash if it is not finite or missing.

    >>> fixed(-1.26, 1), fixed(None, 1)
    ('−1.3', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", MINUS)  # + 0.0 turns -0 into 0


def inline(kind: str, content: bytes) -> str:
    """Return a file as a data URL, for example of the kind image/png."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
