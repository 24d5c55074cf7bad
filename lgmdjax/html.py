"""Display of dataclasses in notebooks: a table of the fields with their values and their comments in the source.

The comment beside a field gives its unit and meaning. The table shows that comment, so the text exists only once.
"""

import ast
import dataclasses
import inspect
import tokenize
from collections.abc import Iterator, Mapping
from functools import cache
from html import escape
from io import StringIO
from itertools import islice

import numpy as np

MAX_ROWS = 80
CELL = "text-align: left; vertical-align: top"


class NotebookTable:
    """A dataclass that notebooks show as a table of its parts: name, value, unit and meaning."""

    def _repr_html_(self) -> str:
        name = type(self).__module__.removeprefix("lgmdjax.") + "." + type(self).__qualname__
        rows = list(islice(_rows(self, ""), MAX_ROWS + 1))
        if len(rows) > MAX_ROWS:
            rows[MAX_ROWS:] = [("...", "", "")]
        return f"<div>{self._picture()}{table(('', name, 'unit, meaning'), rows)}</div>"

    def _picture(self) -> str:
        """Return a picture as SVG, to be shown above the table; none by default."""
        return ""


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table as HTML; texts are escaped.

    >>> table(("name",), [("a < b",)]).count("a &lt; b")
    1
    """
    head = "".join(f'<th style="{CELL}">{escape(cell)}</th>' for cell in header)
    lines = ("".join(f'<td style="{CELL}">{escape(cell)}</td>' for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


@cache
def comments(kind: type) -> Mapping[str, str]:
    """Return the comment beside each field of a dataclass, or the text below it; empty where the source is missing."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        try:
            source = inspect.cleandoc(inspect.getsource(base))
            body = ast.parse(source).body[0]
        except (OSError, TypeError, SyntaxError):
            continue
        if isinstance(body, ast.ClassDef):
            found |= _of_class(body, source)
    return found


def _of_class(body: ast.ClassDef, source: str) -> dict[str, str]:
    tokens = tokenize.generate_tokens(StringIO(source).readline)
    beside = {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}
    found = {}
    for statement, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            below = after.value if isinstance(after, ast.Expr) else None
            text = below.value if isinstance(below, ast.Constant) and isinstance(below.value, str) else ""
            found[statement.target.id] = " ".join((beside.get(statement.end_lineno or 0) or text).split())
    return found


def _rows(value: object, name: str, comment: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield name, value and comment of each part of a dataclass, a mapping or a tuple."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and type(value).__str__ is object.__str__:
        said = comments(type(value))
        fields = dataclasses.fields(value)
        parts = [(field.name, getattr(value, field.name, None), said.get(field.name, "")) for field in fields]
    elif isinstance(value, Mapping):
        parts = [(str(key), part, "") for key, part in value.items()]
    elif isinstance(value, tuple) and not all(np.isscalar(part) for part in value):
        parts = [(str(index), part, "") for index, part in enumerate(value)]
    else:
        yield name, _leaf(value), comment
        return
    for part, child, said in parts:
        yield from _rows(child, f"{name}.{part}".lstrip("."), said)


def _leaf(value: object) -> str:
    """Return the text of a number or a short array; of a long array its dtype, shape and range."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if inspect.ismodule(value):
        return value.__name__
    if shape is None or dtype is None:
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    described = f"{dtype}{list(shape)}"
    try:
        array = np.asarray(value)
        if array.size <= 4:
            return str(np.array2string(array, precision=5, separator=", "))
        if array.dtype == bool:
            return f"{described}: {int(array.sum())} true"
        return f"{described}: {array.min():.4g} to {array.max():.4g}"
    except (TypeError, ValueError, RuntimeError):  # random keys, traced arrays, arrays that were donated
        return described
