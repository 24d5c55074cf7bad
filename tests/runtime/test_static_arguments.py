"""Static arguments in the keys of stored programs: known by value and place, or refused."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from lgmdjax.control import policies
from lgmdjax.detectors import emd
from lgmdjax.runtime import static_arguments

EVERY_POLICY = (*policies.POLICIES, policies.SWITCH)


def test_policies_are_known_apart_and_without_an_address() -> None:
    """An address in memory would be another in every process."""
    texts = {repr(static_arguments.describe({"policy": policy, "frames": 3})) for policy in EVERY_POLICY}
    assert len(texts) == len(EVERY_POLICY)
    assert not any(" at 0x" in text for text in texts)


def test_values_are_known_by_name_and_value() -> None:
    described = static_arguments.describe({"frames": 3, "parts": ("lgmd", policies.BLIND)})
    assert described == static_arguments.describe({"parts": ["lgmd", policies.BLIND], "frames": 3})
    assert described != static_arguments.describe({"frames": 4, "parts": ("lgmd", policies.BLIND)})


def within() -> Callable[[], int]:
    """Return a closure."""
    number = 3
    return lambda: number


@pytest.mark.parametrize("function", [within(), math.sin, functools.partial(policies.get_policy, "blind"), int])
def test_what_may_change_unnoticed_is_refused(function: Callable[..., object]) -> None:
    """A closure, whoever wrote it, and what is not of this package."""
    with pytest.raises(ValueError, match="expected a function of lgmdjax that is no closure"):
        static_arguments.describe({"frames": 3, "policy": (policies.BLIND, function)})


@dataclass
class Field:
    number: float
    function: object = field(metadata={"pytree_node": False}, default=None)


def test_static_fields_are_found_at_any_depth() -> None:
    tree = {"a": [Field(1.0, "x"), (Field(2.0, emd), None)]}
    assert list(static_arguments.static_fields(tree)) == ["x", emd]


@pytest.mark.parametrize("foreign", [pytest, Field(1.0, math.sin), object.__new__(type("Own", (), {}))])
def test_a_module_or_object_of_another_package_is_refused(foreign: object) -> None:
    assert static_arguments.describe([emd]) == [("module", "lgmdjax.detectors.emd")]
    with pytest.raises(ValueError, match="expected"):
        static_arguments.describe({"model": foreign})
