"""Check arguments and results of the package's functions against their annotations, shapes included.

jaxtyping's import hook calls `check` on every function of the package, unless pytest runs with --no-shapes.
"""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

ITERATORS = (
    "lgmdjax.cli.main",
    "lgmdjax.reporting.walk_video",
    "lgmdjax.reporting.video_io",
    "lgmdjax.cli.watch",
)  # not checked: the check of an iterator would consume it
CONSTRUCTORS = ("__init__", "check_single_arg", "check_params")  # JAX calls them with placeholders

# NumPy accepts nested tuples, but at run time its own annotation does not.
ANYTHING = FrozenDict({ArrayLike: object, ArrayLike | None: object})

_check = beartype(conf=BeartypeConf(is_pep484_tower=True, hint_overrides=ANYTHING))  # an int may stand for a float


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function with beartype's check of its annotations, or as it is if the check would do harm."""
    constructs = function.__name__ in CONSTRUCTORS or "__init__" in function.__qualname__
    return function if constructs or function.__module__ in ITERATORS else _check(function)
