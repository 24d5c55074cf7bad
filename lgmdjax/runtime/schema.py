"""Schemas of file contents: types, shapes and ranges of the values that are read.

```python
CAMERA = Object({"width": Integer(1, 4096), "overlap": Number(0.5, 1.0)})
check(CAMERA, header["eyes"], f"{path}: eyes", "train again")
```

Numbers are finite; text and booleans are not numbers. Objects may have further fields, which newer versions write.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lgmdjax.errors import InputError, one_line

LARGEST = sys.float_info.max


@dataclass(frozen=True)
class Number:
    """A finite number in a range."""

    low: float = -LARGEST
    high: float = LARGEST

    def __str__(self) -> str:
        return f"a finite number{_limits(self.low, self.high)}"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is such a number."""
        number = value.item() if isinstance(value, np.generic) else value
        if not isinstance(number, (int, float)) or isinstance(number, bool):
            return False
        return self.low <= number <= self.high


@dataclass(frozen=True)
class Integer(Number):
    """An integer in a range."""

    def __str__(self) -> str:
        return f"an integer{_limits(self.low, self.high)}"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is such an integer."""
        return isinstance(value, (int, np.integer)) and super().accepts(value)


@dataclass(frozen=True)
class Flag:
    """True or false."""

    def __str__(self) -> str:
        return "true or false"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is a boolean."""
        return isinstance(value, bool)


@dataclass(frozen=True)
class Text:
    """Text; one of `choices` if there are any."""

    choices: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"one of {', '.join(self.choices)}" if self.choices else "text"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is such text."""
        return isinstance(value, str) and (not self.choices or value in self.choices)


@dataclass(frozen=True)
class Texts:
    """A list of texts that are not empty: of `length` of them, or of one or more."""

    length: int | None = None

    def __str__(self) -> str:
        return f"a list of {self.length or 'one or more'} texts"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is such a list."""
        if not isinstance(value, list) or not all(isinstance(item, str) and item for item in value):
            return False
        return bool(value) if self.length is None else len(value) == self.length


@dataclass(frozen=True)
class Numbers:
    """An array of finite floats of a shape, in a range."""

    shape: tuple[int, ...] = ()
    low: float = -LARGEST
    high: float = LARGEST

    def __str__(self) -> str:
        return f"finite floats{_limits(self.low, self.high)}, shape {self.shape}"

    def accepts(self, value: object) -> bool:
        """Tell whether a value is such an array."""
        if not isinstance(value, np.ndarray) or value.dtype not in (np.float32, np.float64):
            return False
        return value.shape == self.shape and bool(np.all((value >= self.low) & (value <= self.high)))


@dataclass(frozen=True)
class Object:
    """A JSON object with these fields, and perhaps others; `optional` ones may be missing."""

    fields: Mapping[str, "Schema"] = field(default_factory=dict)
    optional: Mapping[str, "Schema"] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"an object with {', '.join(self.fields)}" if self.fields else "an object"

    def accepts(self, value: object) -> bool:
        """Tell whether a value has all required fields; `check` checks their values."""
        return isinstance(value, Mapping) and self.fields.keys() <= value.keys()


Schema = Number | Flag | Text | Texts | Numbers | Object


def check(expected: Schema, value: object, place: str, remedy: str) -> None:
    """Raise `InputError` unless a value is as expected.

    >>> check(Object({"width": Integer(1, 4096)}), {"width": 80}, "eyes", "train again")
    >>> check(Object({"width": Integer(1, 4096)}), {"width": True}, "eyes", "train again")
    Traceback (most recent call last):
    ...
    lgmdjax.errors.InputError: eyes.width: expected an integer of 1 to 4096, got True; train again

    Args:
        expected: schema of the value.
        value: from a file.
        place: where the value is, for the message.
        remedy: what to do about a wrong value, for the message.
    """
    if not expected.accepts(value):
        raise InputError(f"{place}: expected {expected}, got {_describe(value)}; {remedy}")
    if isinstance(expected, Object) and isinstance(value, Mapping):
        for name, part in {**expected.fields, **expected.optional}.items():
            if name in value:
                check(part, value[name], f"{place}.{name}", remedy)


def _limits(low: float, high: float) -> str:
    if (low, high) == (-LARGEST, LARGEST):
        return ""
    return f" of {low:g} to {high:g}" if high < LARGEST else f" of {low:g} or more"


def _describe(value: object) -> str:
    """Describe a value in a few words; an array by its shape, type and range."""
    if isinstance(value, np.ndarray):
        numbers = value.dtype.kind in "iuf" and value.size > 0
        limits = f", {value.min():g} to {value.max():g}" if numbers else ""
        return f"{value.dtype} of shape {value.shape}{limits}"
    if isinstance(value, Mapping):
        return f"an object with {', '.join(map(str, value)) or 'nothing'}"[:200]
    return one_line(repr(value))[:80]
