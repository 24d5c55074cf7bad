"""Programs that are traced once, and kept on disk beside those that JAX has compiled.

JAX's compilation cache spares XLA's work and not Python's own: to trace a gradient through the whole loop, take it
apart into the way there and the way back, and lower it takes over half a minute, every time. `Kept` is a `jax.jit` that
also keeps what comes of that (`jax.export`, 1 to 2 MB), where JAX keeps its compiled programs; both are read in
seconds.

A program is taken for the same if function and static arguments are, and structure, shapes and precision of the others;
if all files of this package are, byte by byte, since it was imported; and JAX, MJX, devices and JAX's settings. What is
replaced in a module that runs (monkeypatching) is not noticed: do without a cache then.

| file in the cache's folder         | what                                                    |
| ---------------------------------- | ------------------------------------------------------- |
| traced/<function>-<digest>.pickle  | program as StableHLO in bytes, structure of its results |

As those of JAX's own cache, these files are code: a cache is nothing to take from strangers. Nothing deletes those of
older versions of the package.
"""

import functools
import hashlib
import inspect
import os
import pickle
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from lgmdjax.paths import PACKAGE

CACHE = "jax_compilation_cache_dir"


class Kept:
    """A function as under `jax.jit`: positional arguments are trees of arrays, keywords are static.

    Where JAX has no cache on disk, or within another traced function, it is traced like any other. Else it is a program
    for the default backend.

    Args:
        function: pure, of this package, and no closure.
        donated: names of arguments that are used up.
    """

    def __init__(self, function: Callable[..., Any], donated: tuple[str, ...] = ()) -> None:
        functools.update_wrapper(self, function)
        names = list(inspect.signature(function).parameters)
        self._function, self._name = function, function.__name__
        self._donated = tuple(names.index(name) for name in donated)
        self._programs: dict[tuple[str, Path | None], Any] = {}

    def __call__(self, *arguments: Any, **static: Any) -> Any:
        """Call the function."""
        return self.program(*arguments, **static)(*arguments)

    def lower(self, *arguments: Any, **static: Any) -> jax.stages.Lowered:
        """Lower the program of such arguments, as that of a `jax.jit`; compiled, it takes the positional ones."""
        return self.program(*arguments, **static).lower(*arguments)

    def program(self, *arguments: Any, **static: Any) -> Any:
        """Find the program of such arguments, in memory or on disk, or else trace it: a `jax.jit` of them alone."""
        digest = _digest(self._function, jax.tree.map(lambda leaf: str(jax.typeof(leaf)), arguments), static)
        inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(arguments))
        folder = None if inside else _folder()
        if (digest, folder) not in self._programs:
            function = functools.partial(self._function, **static)
            if folder is not None:
                place = folder / f"{self._name}-{digest}.pickle"
                function = _read(place) or _trace(function, arguments, place)
            self._programs[digest, folder] = jax.jit(function, donate_argnums=self._donated)
        return self._programs[digest, folder]


def _folder() -> Path | None:
    """Give the place for traced programs in JAX's cache; None if there is none, or it is in a store elsewhere."""
    cache = getattr(jax.config, CACHE)
    return None if cache is None or "://" in cache else Path(cache, "traced")


def _digest(function: Callable[..., Any], types: Any, static: dict[str, Any]) -> str:
    """Sum up all that a program hangs on."""
    name = function.__module__, function.__qualname__
    versions = [version(name) for name in ("jax", "jaxlib", "mujoco-mjx")]
    # All that could change what is traced, and much that does not: to trace anew in vain is the lesser harm.
    names = [name for name in sorted(jax.config.values) if "cache" not in name]
    settings = [str(getattr(jax.config, name, jax.config.values[name])) for name in names]
    devices = [jax.default_backend(), jax.local_device_count()]
    everything = name, types, sorted(static.items()), versions, settings, devices, SOURCES
    # In words: of equal things pickle makes other bytes where parts of them are one object.
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        return hashlib.sha256(repr(everything).encode()).hexdigest()[:32]


def _sum(folder: Path) -> str:
    """Sum up the files of a package."""
    whole = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            whole.update(f"{path.relative_to(folder)}\n".encode() + hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


SOURCES = _sum(PACKAGE)
"""Of this package, when it was imported: what is edited later is not what runs."""


def _trace(function: Callable[..., Any], arguments: tuple[Any, ...], place: Path) -> Callable[..., Any]:
    """Trace a function and write it down."""
    leaves, structure = jax.tree.flatten(arguments)
    results: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        found, kind = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        results.append(kind)
        return found

    exported = export.export(jax.jit(flat))(*map(jax.typeof, leaves))
    # A structure can be written only as something that has it.
    example = jax.tree.unflatten(results[0], [0] * results[0].num_leaves)
    _write(place, pickle.dumps((bytes(exported.serialize()), example)))
    return _called(exported, results[0])


def _read(place: Path) -> Callable[..., Any] | None:
    """Read a traced program; None if there is none, or none that can be read."""
    if not place.exists():
        return None
    try:
        program, example = pickle.loads(place.read_bytes())
        return _called(export.deserialize(bytearray(program)), jax.tree.structure(example))
    except Exception as error:  # a damaged pickle may raise anything
        warnings.warn(f"{place} cannot be read ({error!r}); it is made anew", stacklevel=4)
        return None


def _write(place: Path, content: bytes) -> None:
    """Write a file whole or not at all; a cache that cannot be written is none."""
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=place.parent) as folder:
            file = Path(folder, place.name)
            file.write_bytes(content)
            os.replace(file, place)
    except OSError as error:
        warnings.warn(f"a traced program is not kept: {error}", stacklevel=5)


def _called(exported: export.Exported, results: Any) -> Callable[..., Any]:
    # JAX looks up where SciPy has LAPACK when it lowers a call of it; else a program that was read crashes (jax#29610).
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))

    # JAX refuses to call a program for several devices where no argument is on them.
    everywhere = Mesh(np.asarray(jax.local_devices()[: exported.nr_devices]), ("device",))

    def placed(leaf: Any) -> Array:
        anyhow = PartitionSpec(*[PartitionSpec.UNCONSTRAINED] * jnp.ndim(leaf))
        return jax.lax.with_sharding_constraint(leaf, NamedSharding(everywhere, anyhow))

    def call(*arguments: Any) -> Any:
        return jax.tree.unflatten(results, exported.call(*map(placed, jax.tree.leaves(arguments))))

    return call
