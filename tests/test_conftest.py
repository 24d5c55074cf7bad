"""The fixtures hold what they promise; every float32 or strict test leans on them."""

import jax.numpy as jnp
import pytest


def test_tests_run_in_double() -> None:
    assert jnp.ones(1).dtype == jnp.float64


def test_precision_is_what_it_says(precision: str) -> None:
    assert jnp.ones(1).dtype == precision


@pytest.mark.usefixtures("float32")
def test_float32_is_single() -> None:
    assert jnp.ones(1).dtype == jnp.float32


@pytest.mark.usefixtures("strict")
def test_strict_refuses_mixed_types() -> None:
    with pytest.raises(Exception, match="dtype_promotion=strict"):
        _ = jnp.ones(1) + jnp.arange(1)
