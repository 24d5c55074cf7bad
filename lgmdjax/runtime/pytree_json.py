"""Structures of pytrees as JSON: what pickle would store, without the code that pickle would run.

`encode` writes the structure of a tree as JSON values, `decode` makes a tree of that structure:

| part of a tree                             | JSON                                                       |
| ------------------------------------------ | ---------------------------------------------------------- |
| leaf                                       | {"leaf": null}                                             |
| None, and static bool, int, float, str     | the value itself                                           |
| tuple, list, dict with str keys            | {"tuple": [...]}, {"list": [...]}, {"dict": {...}}         |
| named tuple                                | {"namedtuple": ["module:class", {field: ...}]}             |
| dataclass that is registered as a pytree   | {"dataclass": ["module:class", {field: ...}]}              |
| static member of an Enum                   | {"enum": ["module:class", member]}                         |
| static module                              | {"module": name}                                           |
| static NumPy array or scalar               | {"array": [dtype, shape, hex]}, {"scalar": [dtype, hex]}   |

Fields of a dataclass are written whether they are static or not; registration says which are. Everything else raises
`ValueError`.

A hostile document can at most raise an exception. Classes are looked up by name, among modules that are imported
already and that belong to the packages that the caller lists. Instances are made without calling `__init__`, members of
an Enum without calling the class.
"""

import dataclasses
import sys
from collections.abc import Collection, Mapping
from enum import Enum
from types import ModuleType
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

_LEAF = object()
_NUMBERS = "biufc"  # kinds of NumPy dtypes that are plain bytes


def encode(tree: PyTree, packages: Collection[str]) -> object:
    """Encode the structure of a tree whose classes belong to `packages`; raise `ValueError` if JSON cannot hold it.

    >>> encode({"a": 1.0, "b": (2.0, None)}, packages=())
    {'dict': {'a': {'leaf': None}, 'b': {'tuple': [{'leaf': None}, None]}}}
    """
    template = jax.tree.map(lambda _: _LEAF, tree)
    encoded = _encode(template, packages)
    if jax.tree.structure(_decode(encoded, packages)) != jax.tree.structure(template):
        raise ValueError(f"expected a structure that JSON can hold, got {jax.tree.structure(template)}")
    return encoded


def decode(encoded: object, packages: Collection[str]) -> PyTree:
    """Return a tree of the structure that `encode` wrote, with placeholders as leaves; raise for anything else.

    >>> jax.tree.structure(decode({"list": [{"leaf": None}, None]}, packages=()))
    PyTreeDef([*, None])
    """
    return _decode(encoded, packages)


def _encode(value: object, packages: Collection[str]) -> object:
    if value is _LEAF:
        return {"leaf": None}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, Enum):
        return {"enum": [_class_name(type(value), packages), value.name]}
    if isinstance(value, ModuleType):
        return {"module": _find_module(value.__name__, packages).__name__}
    if isinstance(value, (np.ndarray, np.generic)):
        return _encode_numbers(value)
    if type(value) is tuple or type(value) is list:
        return {type(value).__name__: [_encode(item, packages) for item in value]}
    if type(value) is dict and all(type(key) is str for key in value):
        return {"dict": {key: _encode(item, packages) for key, item in value.items()}}
    kind = "namedtuple" if isinstance(value, tuple) else "dataclass"
    name = _class_name(type(value), packages)
    fields = {field: _encode(getattr(value, field), packages) for field in _field_names(type(value))}
    return {kind: [name, fields]}


def _decode(encoded: Any, packages: Collection[str]) -> object:
    if not isinstance(encoded, dict):
        return encoded
    ((kind, content),) = encoded.items()
    match kind:
        case "leaf":
            return _LEAF
        case "tuple" | "list":
            items = [_decode(item, packages) for item in content]
            return tuple(items) if kind == "tuple" else items
        case "dict":
            return {key: _decode(item, packages) for key, item in content.items()}
        case "enum":
            return _find_enum(content[0], packages).__members__[content[1]]
        case "module":
            return _find_module(content, packages)
        case "array":
            return _decode_numbers(content[0], content[2]).reshape(content[1])
        case "scalar":
            return _decode_numbers(*content)[0]
        case "namedtuple" | "dataclass":
            fields = {field: _decode(value, packages) for field, value in content[1].items()}
            return _make(_find_class(content[0], packages), fields)
    raise ValueError(f"expected a part of a pytree, got {kind!r}")


def _make(made: type, fields: Mapping[str, object]) -> object:
    """Make an instance of a class that is registered as a pytree, without calling its `__init__`."""
    if tuple(fields) != _field_names(made):
        raise ValueError(f"expected the fields {_field_names(made)} of {made}, got {tuple(fields)}")
    if issubclass(made, tuple):
        return tuple.__new__(made, fields.values())
    instance = object.__new__(made)
    for field, value in fields.items():
        object.__setattr__(instance, field, value)
    if jax.tree_util.all_leaves([instance]):
        raise ValueError(f"expected a class that is registered as a pytree, got {made}")
    return instance


def _field_names(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a named tuple or dataclass."""
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return tuple(kind._fields)  # pyright: ignore[reportAttributeAccessIssue]
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    raise ValueError(f"expected a named tuple or a dataclass, got {kind}")


def _class_name(kind: type, packages: Collection[str]) -> str:
    """Return the name of a class; raise `ValueError` if `_find_class` would not find it."""
    name = f"{kind.__module__}:{kind.__qualname__}"
    if _find_class(name, packages) is not kind:
        raise ValueError(f"expected a class that is found by its name, got {kind}")
    return name


def _find_enum(name: str, packages: Collection[str]) -> type[Enum]:
    found = _find_class(name, packages)
    if not issubclass(found, Enum):
        raise ValueError(f"expected an Enum, got {name}")
    return found


def _find_class(name: str, packages: Collection[str]) -> type:
    """Find a class by "module:class" without importing anything and without calling anything."""
    module, _, path = name.partition(":")
    found: object = _find_module(module, packages)
    for part in path.split("."):
        found = vars(found).get(part)  # getattr could import, as packages with lazy imports do
        if not isinstance(found, type):
            raise ValueError(f"expected the name of a class, got {name}")
    if not isinstance(found, type) or (found.__module__, found.__qualname__) != (module, path):
        raise ValueError(f"expected the name of a class, got {name}")
    return found


def _find_module(name: str, packages: Collection[str]) -> ModuleType:
    """Find an imported module by its name."""
    if name.partition(".")[0] not in packages or name not in sys.modules:
        raise ValueError(f"expected an imported module of {sorted(packages)}, got {name}")
    return sys.modules[name]


def _encode_numbers(value: np.ndarray | np.generic) -> dict[str, list[object]]:
    if value.dtype.kind not in _NUMBERS:
        raise ValueError(f"expected an array of numbers, got one of {value.dtype}")
    if isinstance(value, np.generic):
        return {"scalar": [value.dtype.str, value.tobytes().hex()]}
    return {"array": [value.dtype.str, list(value.shape), value.tobytes().hex()]}


def _decode_numbers(dtype: str, content: str) -> np.ndarray:
    if np.dtype(dtype).kind not in _NUMBERS:
        raise ValueError(f"expected an array of numbers, got one of {dtype}")
    return np.frombuffer(bytes.fromhex(content), dtype)
