"""The interface of a looming detector: four names of a module, or of any object.

| name     | meaning                                                                                                  |
| -------- | -------------------------------------------------------------------------------------------------------- |
| Params   | a pytree; `Params()` has the published constants                                                         |
| init     | init(params, frame) -> state                                                                             |
| step     | step(params, state, frame) -> (state, response), for one eye; scan and vmap are the caller's             |
| Response | has `u`, 0.5 without motion and up to 1, and `excitation`, which is not squashed; other fields are free  |
| check    | optional: check(params) raises `InputError` for impossible constants                                     |

Every detector of this package has this interface, and so has the template of the page "Write your own detector". The
ideal observers have it too, but get the object's true size instead of a frame.
"""

import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PyTree

from lgmdjax.detectors.cells import Scalar
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import checksums


class Response(Protocol):
    """What a detector returns for each frame."""

    @property
    def u(self) -> Float[Array, ""]: ...

    @property
    def excitation(self) -> Float[Array, ""]: ...


@runtime_checkable
class Detector(Protocol):
    """A looming detector of one eye; modules qualify."""

    @property
    def Params(self) -> Callable[[], Any]: ...

    @property
    def init(self) -> Callable[[Any, Any], Any]: ...

    @property
    def step(self) -> Callable[[Any, Any, Any], tuple[Any, Any]]: ...


@struct.dataclass(kw_only=True)
class Geometry:
    """True size and expansion of the object that an eye sees; zero without an object."""

    size: Scalar  # theta, the full angle [rad]
    rate: Scalar  # its derivative [rad/s]


def name(detector: Detector) -> str:
    """Return the name of a detector: that of its module or object, or of its type.

    >>> from lgmdjax.detectors import emd
    >>> name(emd)
    'emd'
    """
    own: str = getattr(detector, "__name__", type(detector).__name__)
    return own.removeprefix(f"{__package__}.")


def identify(detector: Detector) -> str:
    """Return a text that distinguishes a detector from all others: its name and, if it is your own, its source.

    Raises `InputError` for a `step` that is not in a file.
    """
    if isinstance(detector, ModuleType) and detector.__name__.startswith(f"{__package__}."):
        return name(detector)
    try:
        source = Path(inspect.getsourcefile(inspect.unwrap(detector.step)) or "").read_bytes()
    except (OSError, TypeError) as error:
        raise InputError(
            f"detector {name(detector)}: expected a function step in a file, got none ({one_line(error)}); "
            "save the detector as a module"
        ) from error
    return f"{name(detector)} {checksums.digest(source)}"


def check(detector: Detector, params: PyTree, frame: jax.ShapeDtypeStruct) -> None:
    """Raise `InputError` unless a detector can be scanned over frames like this one; nothing is computed.

    Args:
        detector: a module, or any object that is hashable.
        params: its parameters, which its own `check` sees first if it has one.
        frame: shape and type of a frame.
    """
    called = f"detector {name(detector)}"
    try:
        hash(detector)
        getattr(detector, "check", lambda _: None)(params)
        before = jax.eval_shape(detector.init, params, frame)
        after, outputs = jax.eval_shape(partial(_outputs, detector), params, before, frame)
    except InputError:
        raise
    except Exception as error:  # whatever the code of a user raises
        raise InputError(
            f"{called}: expected init and step for a frame of {frame.dtype} {frame.shape}, got {one_line(error)}; "
            "see lgmdjax.detectors.protocol"
        ) from error
    if jax.tree.structure(before) != jax.tree.structure(after) or _types(before) != _types(after):
        raise InputError(f"{called}: expected a state like {before} after a step, got {after}; keep shapes and types")
    shapes = {part: output.shape for part, output in outputs.items()}
    if any(shape != () for shape in shapes.values()):
        raise InputError(f"{called}: expected one u and one excitation a frame, got shapes {shapes}; reduce them")


def _outputs(detector: Detector, params: PyTree, state: PyTree, frame: Array) -> tuple[PyTree, dict[str, Array]]:
    state, response = detector.step(params, state, frame)
    return state, {part: jnp.asarray(getattr(response, part)) for part in ("u", "excitation")}


def _types(tree: PyTree) -> list[tuple[tuple[int, ...], Any]]:
    return [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tree)]
