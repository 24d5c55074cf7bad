"""The fixtures and the flags do what they promise; every float32 or strict test relies on them."""

import os

import conftest
import jax.numpy as jnp
import pytest


def test_tests_run_in_double_precision() -> None:
    assert jnp.ones(1).dtype == jnp.float64


def test_precision_names_the_dtype(precision: str) -> None:
    assert jnp.ones(1).dtype == precision


@pytest.mark.usefixtures("float32")
def test_float32_is_single_precision() -> None:
    assert jnp.ones(1).dtype == jnp.float32


@pytest.mark.usefixtures("strict")
def test_strict_refuses_mixed_types() -> None:
    with pytest.raises(Exception, match="dtype_promotion=strict"):
        _ = jnp.ones(1) + jnp.arange(1)


@pytest.mark.skipif(not conftest.DEFAULT_XLA, reason="LGMDJAX_TEST_DEFAULT_XLA=1 asks for the default flags")
def test_default_flags_are_those_of_users() -> None:
    assert "fusion" not in os.environ.get("XLA_FLAGS", "")


def test_tests_for_the_default_flags_are_marked(request: pytest.FixtureRequest) -> None:
    marked = {item.path.name for item in request.session.items if item.get_closest_marker("default_xla")}
    collected = {item.path.name for item in request.session.items}
    assert marked >= collected & set(conftest.DEFAULT_XLA_FILES)
    for name in conftest.DEFAULT_XLA_FILES:
        assert list(conftest.ROOT.glob(f"tests/**/{name}")), f"expected tests/**/{name}, found none"
