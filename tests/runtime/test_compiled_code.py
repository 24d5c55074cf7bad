"""Compiled programs are released when a process has used much of its memory mappings, and not before."""

from typing import Any

import jax
import pytest

from lgmdjax.runtime import compiled_code


@pytest.fixture
def program():
    """A compiled program."""
    double: Any = jax.jit(lambda x: 2 * x)
    double(1.0)
    assert double._cache_size() == 1
    return double


@pytest.mark.skipif(not compiled_code.LIMIT_FILE.exists(), reason="only Linux has a limit")
@pytest.mark.parametrize(("fraction", "left"), [(0.0, 0), (1.0, 1)])
def test_clears_programs_above_a_fraction_of_the_limit(program, fraction, left):
    compiled_code.clear_caches_if_near_limit(fraction)
    assert program._cache_size() == left


def test_clears_nothing_on_systems_without_a_limit(program, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled_code, "LIMIT_FILE", tmp_path / "none")
    compiled_code.clear_caches_if_near_limit(0.0)
    assert program._cache_size() == 1
