"""Cache traced programs on disk, next to the programs that JAX has compiled.

JAX's own cache saves compilation by XLA, but not tracing by Python: tracing and lowering a closed-loop rollout takes
ten seconds in every process, and its gradient more than half a minute. `cached_jit` is a `jax.jit` that also stores the
result of that work (`jax.export`, 1 to 2 MB), in a folder of JAX's cache. Another process reads it in seconds.

A stored program is used again only if all of these are the same: function, static arguments, structure, shapes and
precision of the other arguments, every byte of this package when it was imported, versions of JAX and MJX, devices, and
JAX's settings. Attributes that are replaced in an imported module (monkeypatching) are not noticed; disable the cache
for that. Static arguments, and static fields of the others, may contain functions and modules. A program is stored only
if all of them belong to this package and none is a closure, since the source of others may change unnoticed.

| exported/<function>-<key>-<release>.program | content                                                        |
| ------------------------------------------- | -------------------------------------------------------------- |
| key                                         | hash of everything that a program depends on                   |
| release                                     | hash of the versions of this package, JAX and MJX              |
| first line of the file                      | SHA-256 of all that follows                                    |
| second line                                 | JSON: format, version, key, structure of the results           |
| the rest                                    | the program, from `jax.export.Exported.serialize`              |

Writing a program deletes those of other releases.

Reading a file runs no code that the file chooses: the structure is data (`pytree_json`), and the program is StableHLO
that may call linear algebra and random bits, but neither Python nor kernels of its own (`ALLOWED_CALLS`). A hostile
program could still return wrong numbers or crash the process, and the checksum has no key: it detects damage, not
malice. The folder is therefore private to its owner (mode 0700), and folders and files that another user owns or may
write to are not used. Windows has no such modes; there, only the access lists of users' folders protect them. The
parent folder, JAX's own cache, holds machine code: whoever may write there can run code.
"""

import functools
import inspect
import json
import os
import re
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from lgmdjax.errors import one_line
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.runtime import checksums, partial_files, pytree_json, static_arguments

P = ParamSpec("P")
R = TypeVar("R")

CACHE_OPTION = "jax_compilation_cache_dir"
FORMAT, VERSION = "lgmdjax traced program", 2
RESULT_PACKAGES = frozenset({"lgmdjax", "mujoco", "optax", "flax"})  # whose classes may be part of results
OWN_FILES = re.compile(rf".+-[0-9a-f]{{32}}-(?P<release>[0-9a-f]{{16}})\.program(\.\d+{re.escape(checksums.PARTIAL)})?")
ALLOWED_CALLS = (
    r"@(?:(?:lapack|blas|cublas|cusolver|hipblas|hipsolver)_\w+|(?:cu|hip)_threefry2x32\w*"
    r"|Sharding|SPMDFullToShardShape|SPMDShardToFullShape)\("
)


class CachedFunction(Generic[P, R]):
    """The result of `cached_jit`."""

    __name__: str
    __wrapped__: Callable[P, R]

    def __init__(self, function: Callable[P, R], donate_argnames: tuple[str, ...] = ()) -> None:
        functools.update_wrapper(self, function)
        names = list(inspect.signature(function).parameters)
        self._function: Callable[..., R] = function
        self._donated = tuple(names.index(name) for name in donate_argnames)
        self._programs: dict[tuple[str, Path | None], jax.stages.Wrapped] = {}

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function."""
        return self.program(*args, **kwargs)(*args)

    def lower(self, *args: P.args, **kwargs: P.kwargs) -> jax.stages.Lowered:
        """Lower the program for such arguments, as `jax.jit` does; compiled, it takes the positional ones."""
        return self.program(*args, **kwargs).lower(*args)

    def program(self, *args: P.args, **kwargs: P.kwargs) -> jax.stages.Wrapped:
        """Find the program for such arguments in memory or on disk, or trace it; return a `jax.jit` of it."""
        types = jax.tree.map(lambda leaf: str(jax.typeof(leaf)), args)
        inside_trace = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(args))
        try:
            own = list(static_arguments.static_fields(args))
            static, folder = static_arguments.describe((own, kwargs)), None if inside_trace else _cache_folder()
        except ValueError:
            static, folder = kwargs, None
        key = _program_key(self._function, types, static)
        if (key, folder) not in self._programs:
            function = functools.partial(self._function, **kwargs)
            if folder is not None and _is_usable(folder):
                file = folder / f"{self._function.__name__}-{key}-{_release()}.program"
                function = _read(file, key, self._packages) or _trace(function, args, file, key, self._packages)
            self._programs[key, folder] = jax.jit(function, donate_argnums=self._donated)
        return self._programs[key, folder]

    @property
    def _packages(self) -> frozenset[str]:
        return RESULT_PACKAGES | {self._function.__module__.partition(".")[0]}


@overload
def cached_jit(function: Callable[P, R], *, donate_argnames: tuple[str, ...] = ()) -> CachedFunction[P, R]: ...
@overload
def cached_jit(*, donate_argnames: tuple[str, ...] = ()) -> Callable[[Callable[P, R]], CachedFunction[P, R]]: ...
def cached_jit(function: Any = None, *, donate_argnames: tuple[str, ...] = ()) -> Any:
    """Compile a function as `jax.jit` does, and store the traced program on disk.

    Positional arguments are pytrees of arrays, keyword arguments are static. If JAX has no cache on disk, or inside
    another traced function, this is `jax.jit` alone. Otherwise the program is for the default backend, and cannot be
    differentiated.

    Args:
        function: pure, and no closure. Its static arguments are plain values, dataclasses and functions.
        donate_argnames: names of arguments whose memory the results may use (`jax.jit`).
    """
    if function is None:
        return functools.partial(cached_jit, donate_argnames=donate_argnames)
    return CachedFunction(function, donate_argnames)


def hash_folder(folder: Path) -> str:
    """Return a hash of the names and contents of all files in a folder and below."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and "__pycache__" not in path.parts)
    lines = (f"{path.relative_to(folder)} {checksums.digest(path.read_bytes())}\n" for path in files)
    return checksums.digest(*(line.encode() for line in lines))


PACKAGE_DIGEST = hash_folder(PACKAGE_DIR)
"""Hash of this package when it was imported: later edits do not change the code that runs."""


@functools.cache
def _library_versions() -> tuple[str, ...]:
    return tuple(version(name) for name in ("jax", "jaxlib", "mujoco-mjx"))


def _release() -> str:
    """Return a hash of the versions that every program depends on."""
    return checksums.digest(repr((PACKAGE_DIGEST, *_library_versions())).encode())[:16]


def _program_key(function: Callable[..., object], types: PyTree[str], static: object) -> str:
    """Return a hash of everything that a program depends on."""
    name = function.__module__, function.__qualname__
    # All settings that could change what is traced, and many that do not: an unneeded trace does little harm.
    names = [name for name in sorted(jax.config.values) if "cache" not in name]
    settings = [str(getattr(jax.config, name, jax.config.values[name])) for name in names]
    devices = [jax.default_backend(), jax.local_device_count()]
    everything = name, types, static, _release(), settings, devices
    # As text: pickle gives different bytes for equal values if some of them share objects.
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        return checksums.digest(repr(everything).encode())[:32]


def _cache_folder() -> Path | None:
    """Return the folder for traced programs in JAX's cache; None if there is no cache, or not on a local disk."""
    cache = getattr(jax.config, CACHE_OPTION)
    return None if cache is None or "://" in cache else Path(cache, "exported")


def _is_usable(folder: Path) -> bool:
    """Make a private folder; warn and return False if that fails, or if other users may write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_private(folder, folder.stat())
    except OSError as error:
        warnings.warn(
            f"traced programs are not cached: {error}; set JAX_COMPILATION_CACHE_DIR to a folder of your own",
            stacklevel=4,
        )
        return False
    return True


def _check_private(path: Path, status: os.stat_result) -> None:
    """Raise `PermissionError` for a file or folder that another user owns or may write to."""
    if not hasattr(os, "getuid"):
        return
    if status.st_uid != os.getuid():
        raise PermissionError(f"expected {path} to be owned by this user, got user {status.st_uid}")
    if status.st_mode & 0o022:
        raise PermissionError(f"expected {path} to be writable by its owner alone, got mode {status.st_mode & 0o777:o}")


def _trace(
    function: Callable[..., PyTree], args: tuple[PyTree, ...], file: Path, key: str, packages: frozenset[str]
) -> Callable[..., PyTree]:
    """Trace a function and store the program; return a function that calls it."""
    leaves, structure = jax.tree.flatten(args)
    results: list[PyTree] = []

    def flat(*leaves: Array) -> list[Array]:
        result = function(*jax.tree.unflatten(structure, leaves))
        results.append(jax.tree.map(lambda _: 0, result))
        return jax.tree.leaves(result)

    try:
        exported = export.export(jax.jit(flat))(*map(jax.typeof, leaves))
    except (ValueError, NotImplementedError) as error:  # such as calls of Python
        warnings.warn(f"a traced program is not cached: {error}", stacklevel=4)
        return function
    try:
        _check_calls(exported)
        encoded = pytree_json.encode(results[0], packages)
        header = {"format": FORMAT, "version": VERSION, "key": key, "results": encoded}
        _write(file, json.dumps(header).encode() + b"\n" + bytes(exported.serialize()))
    except (OSError, ValueError) as error:
        warnings.warn(f"a traced program is not cached: {error}", stacklevel=4)
    return _caller(exported, results[0])


def _write(file: Path, content: bytes) -> None:
    """Write a program with its checksum, and delete those of other releases."""
    with partial_files.replacing(file) as partial:
        partial.touch(mode=0o600)
        partial.write_bytes(checksums.digest(content).encode() + b"\n" + content)
    for other in file.parent.iterdir():
        name = OWN_FILES.fullmatch(other.name)
        if name and name["release"] != _release():
            other.unlink(missing_ok=True)


def _read(file: Path, key: str, packages: frozenset[str]) -> Callable[..., PyTree] | None:
    """Read a stored program; None if there is none. Delete a file that cannot be read, with a warning."""
    try:
        with file.open("rb") as stream:
            _check_private(file, os.fstat(stream.fileno()))
            content = stream.read()
        return _caller(*_parse(content, key, packages))
    except FileNotFoundError:
        return None
    except Exception as error:  # whatever a damaged or hostile file makes JSON, JAX or MLIR raise
        reason = one_line(error)[:200]
        warnings.warn(f"{file} cannot be read ({reason}); it is deleted and made again", stacklevel=4)
        file.unlink(missing_ok=True)
        return None


def _parse(content: bytes, key: str, packages: frozenset[str]) -> tuple[export.Exported, PyTree]:
    """Return the program in a file and a tree of the structure of its results; raise an exception if it is damaged."""
    checksum, _, rest = content.partition(b"\n")
    if checksum != checksums.digest(rest).encode():
        raise ValueError("its checksum is wrong")
    text, _, program = rest.partition(b"\n")
    header = json.loads(text)
    if (header["format"], header["version"], header["key"]) != (FORMAT, VERSION, key):
        raise ValueError("it belongs to another program")
    results = pytree_json.decode(header["results"], packages)
    exported = export.deserialize(bytearray(program))
    if len(exported.out_avals) != len(jax.tree.leaves(results)):
        raise ValueError("it returns another number of arrays than it declares")
    _check_calls(exported)
    return exported, results


def _check_calls(exported: export.Exported) -> None:
    """Raise `ValueError` for a program that calls code other than linear algebra and random bits."""
    foreign = re.search(rf"custom_call(?! {ALLOWED_CALLS}).{{0,60}}", exported.mlir_module())
    if foreign:
        raise ValueError(f"it calls code outside of XLA ({foreign[0]})")


def _caller(exported: export.Exported, results: PyTree) -> Callable[..., PyTree]:
    """Return a function that calls a program and gives its results the structure of `results`."""
    structure = jax.tree.structure(results)
    # JAX finds SciPy's LAPACK when it lowers a call of it; without this, a program that was read crashes (jax#29610).
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))

    # JAX refuses to call a program for several devices if no argument is on them.
    mesh = Mesh(np.asarray(jax.local_devices()[: exported.nr_devices]), ("device",))

    def placed(leaf: Array) -> Array:
        unconstrained = PartitionSpec(*[PartitionSpec.UNCONSTRAINED] * jnp.ndim(leaf))
        return jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, unconstrained))

    def call(*args: PyTree) -> PyTree:
        return jax.tree.unflatten(structure, exported.call(*map(placed, jax.tree.leaves(args))))

    return call
