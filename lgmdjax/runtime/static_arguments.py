"""Static arguments of a compiled program as a part of its key on disk (`lgmdjax.runtime.export_cache`)."""

import dataclasses
import inspect
from collections.abc import Mapping

PACKAGE = __name__.partition(".")[0]


def describe(static: object) -> object:
    """Return values whose `repr` is the same in every process and differs between different arguments.

    A function is described by its position in the source of this package, every byte of which is part of the key too.

    Args:
        static: a plain value, a dataclass, a function, or a tuple, list or mapping of these.

    Raises:
        ValueError: for a closure or a function of another package, whose meaning may change unnoticed.
    """
    if isinstance(static, Mapping):
        return sorted((name, describe(value)) for name, value in static.items())
    if isinstance(static, tuple | list):
        return [describe(value) for value in static]
    if dataclasses.is_dataclass(static) and not isinstance(static, type):
        values = [describe(getattr(static, field.name)) for field in dataclasses.fields(static)]
        return type(static).__module__, type(static).__qualname__, values
    if not callable(static):
        return static
    function = inspect.unwrap(static)
    if not inspect.isfunction(function) or function.__closure__ or function.__module__.partition(".")[0] != PACKAGE:
        raise ValueError(f"expected a function of {PACKAGE} that is no closure, got {static!r}")
    code = function.__code__
    return function.__module__, function.__qualname__, code.co_firstlineno, code.co_code
