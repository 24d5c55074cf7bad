"""Programs are let go of when they fill much of what a process may map, and not before."""

from typing import Any

import jax
import pytest

from lgmdjax.runtime import compiled_code


@pytest.fixture
def program():
    """A program that is compiled."""
    double: Any = jax.jit(lambda x: 2 * x)
    double(1.0)
    assert double._cache_size() == 1
    return double


@pytest.mark.skipif(not compiled_code.ALLOWED.exists(), reason="only Linux has a bound")
@pytest.mark.parametrize(("share", "left"), [(0.0, 0), (1.0, 1)])
def test_lets_go_of_programs_above_a_share_of_what_is_allowed(program, share, left):
    compiled_code.let_go(share)
    assert program._cache_size() == left


def test_lets_go_of_nothing_where_there_is_no_bound(program, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled_code, "ALLOWED", tmp_path / "none")
    compiled_code.let_go(0.0)
    assert program._cache_size() == 1
