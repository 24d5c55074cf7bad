"""Checks what the package's functions are given and give back against their annotations, shapes included.

jaxtyping's import hook calls `check` on every function of the package, unless `pytest --no-shapes` asks not to.
"""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

STREAMS = (
    "lgmdjax.cli.main",
    "lgmdjax.reporting.walk_video",
    "lgmdjax.reporting.video_io",
    "lgmdjax.cli.watch",
)  # looking into a stream uses it up
CONSTRUCTORS = ("__init__", "check_single_arg", "check_params")  # JAX makes pytrees of placeholders through them

# NumPy takes nested tuples too, but its own annotation says no to them at run time.
ANYTHING = FrozenDict({ArrayLike: object, ArrayLike | None: object})

_check = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=ANYTHING))  # an int will do for a float


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let beartype check a function, unless that would do harm."""
    constructs = function.__name__ in CONSTRUCTORS or "__init__" in function.__qualname__
    return function if constructs or function.__module__ in STREAMS else _check(function)
