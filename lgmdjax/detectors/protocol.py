"""The interface of a looming detector: four names of a module, or of any object.

| name     | meaning                                                                                                  |
| -------- | -------------------------------------------------------------------------------------------------------- |
| Params   | a pytree; `Params()` has the published constants                                                         |
| init     | init(params, frame) -> state                                                                             |
| step     | step(params, state, frame) -> (state, response), for one eye; scan and vmap are the caller's             |
| Response | has `u`, 0.5 without motion and up to 1, and `excitation`, which is not squashed; other fields are free  |

Every detector of this package has this interface, and so has the template of the page "Write your own detector". The
ideal observers have it too, but get the object's true size instead of a frame.
"""

from collections.abc import Callable
from typing import Any, Protocol

from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors.cells import Scalar


class Response(Protocol):
    """What a detector returns for each frame."""

    @property
    def u(self) -> Float[Array, ""]: ...

    @property
    def excitation(self) -> Float[Array, ""]: ...


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
