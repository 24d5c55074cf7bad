"""Static arguments of a compiled program as a part of its key on disk (`lgmdjax.runtime.export_cache`)."""

import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from types import ModuleType

PACKAGE = __name__.partition(".")[0]
PLAIN = ("builtins", "numpy", "jax", "jaxlib", "mujoco", PACKAGE)  # packages of objects that are their own description


def describe(static: object) -> object:
    """Return values whose `repr` is the same in every process and differs between different arguments.

    A function is described by its position in the source of this package, every byte of which is part of the key too;
    a module of this package by its name.

    Args:
        static: a plain value, a dataclass, a function, a module, or a tuple, list or mapping of these.

    Raises:
        ValueError: for a closure, or a function, module or object of another package, whose meaning may change
            unnoticed. Objects of JAX and MuJoCo, whose versions are part of the key, are plain values.
    """
    if isinstance(static, Mapping):
        return sorted((name, describe(value)) for name, value in static.items())
    if isinstance(static, tuple | list):
        return [describe(value) for value in static]
    if dataclasses.is_dataclass(static) and not isinstance(static, type):
        values = [describe(getattr(static, field.name)) for field in dataclasses.fields(static)]
        return type(static).__module__, type(static).__qualname__, values
    if isinstance(static, ModuleType):
        if _package(static.__name__) != PACKAGE:
            raise ValueError(f"expected a module of {PACKAGE}, got {static!r}")
        return "module", static.__name__
    if not callable(static):
        if _package(type(static).__module__) not in PLAIN:
            raise ValueError(f"expected an object of {', '.join(PLAIN)}, got {static!r}")
        return static
    function = inspect.unwrap(static)
    if not inspect.isfunction(function) or function.__closure__ or _package(function.__module__) != PACKAGE:
        raise ValueError(f"expected a function of {PACKAGE} that is no closure, got {static!r}")
    code = function.__code__
    return function.__module__, function.__qualname__, code.co_firstlineno, code.co_code


def static_fields(tree: object) -> Iterator[object]:
    """Yield the values of all static fields (`pytree_node=False`) of the dataclasses in a pytree."""
    if isinstance(tree, Mapping):
        tree = tuple(tree.values())
    if isinstance(tree, tuple | list):
        for part in tree:
            yield from static_fields(part)
    elif dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        for field in dataclasses.fields(tree):
            value = getattr(tree, field.name)
            if field.metadata.get("pytree_node", True):
                yield from static_fields(value)
            else:
                yield value


def _package(module: str) -> str:
    return module.partition(".")[0]
