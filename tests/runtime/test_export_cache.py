"""A traced program is read from disk where it is the same, in this process or another, and else traced anew."""

import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from lgmdjax.runtime import export_cache
from lgmdjax.simulation import sharding


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of this test alone: where files of traced programs are, and nothing else of JAX."""
    before = getattr(jax.config, export_cache.CACHE)
    jax.config.update(export_cache.CACHE, str(tmp_path))
    yield tmp_path / "traced"
    jax.config.update(export_cache.CACHE, before)


@pytest.fixture
def counted():
    """Make kept functions, each as new as in a new process; and what they were traced with so far."""
    calls = []

    def solve(places, used, *, power=1):
        calls.append((places["A"].dtype, power))
        factor = jnp.linalg.cholesky(places["A"] @ places["A"].T + jnp.eye(2))
        return {"x": jnp.linalg.solve(factor, used) ** power, "key": jax.random.fold_in(places["key"], 1)}, used + 1

    return lambda: export_cache.Kept(solve, donated=("used",)), calls


def arguments(dtype=None):
    return {"A": jnp.array([[2.0, 1.0], [0.5, 3.0]], dtype), "key": jax.random.key(0)}, jnp.array([1.0, -2.0], dtype)


def assert_solved(found, power=1):
    places, b = jax.device_get(arguments()[0]["A"]), np.array([1.0, -2.0])
    factor = np.linalg.cholesky(places @ places.T + np.eye(2))
    np.testing.assert_allclose(found[0]["x"], np.linalg.solve(factor, b) ** power, rtol=1e-12)
    np.testing.assert_array_equal(found[1], b + 1)
    assert found[0]["key"] == jax.random.fold_in(jax.random.key(0), 1)


def test_is_traced_once(cache, counted):
    make, calls = counted
    for kept in (make(), make()):
        for _ in range(2):
            assert_solved(kept(*arguments()))
    assert len(calls) == 1
    (file,) = cache.iterdir()
    assert file.name.startswith("solve-")


@struct.dataclass
class Tagged:
    """A number with a label that is not traced."""

    number: jax.Array
    label: str = struct.field(pytree_node=False)


def test_what_is_equal_is_the_same(cache):
    """What a program gives, the next call is given: its label is then not the other's own but an equal one, read."""
    traces = []

    def add(a, b):
        traces.append(a.label)
        return replace(b, number=a.number + b.number)

    label = "-".join(["some", "words"])
    for _ in range(2):
        kept, a, b = export_cache.Kept(add), Tagged(jnp.ones(()), label), Tagged(jnp.ones(()), label)
        for _ in range(3):
            b = kept(a, b)
        assert b.number == 4 and b.label == label
    kept(replace(a, label="another"), b)
    assert traces == [label, "another"]


def test_is_traced_anew_for_other_arguments_settings_and_sources(cache, counted, monkeypatch):
    make, calls = counted
    kept = make()
    for power in (1, 2):
        assert_solved(kept(*arguments(), power=power), power)
    kept(*arguments(jnp.float32))
    with jax.default_matmul_precision("highest"):
        kept(*arguments())
    with jax.threefry_partitionable(False):
        kept(*arguments())
    monkeypatch.setattr(export_cache, "SOURCES", "edited")
    kept(*arguments())
    assert len(calls) == len(list(cache.iterdir())) == 6


def test_functions_of_one_name_are_two(cache):
    def more():
        def solve(x):
            return x + 1

        return solve

    def less():
        def solve(x):
            return x - 1

        return solve

    assert [float(export_cache.Kept(make())(jnp.ones(()))) for make in (more, less)] == [2.0, 0.0]


def test_the_package_is_known_by_every_byte(tmp_path):
    (tmp_path / "__pycache__").mkdir()
    sums = []
    for name, content in (("a.py", "1"), ("a.py", "2"), ("b.py", "2"), ("__pycache__/a.pyc", "3")):
        (tmp_path / name).write_text(content)
        sums.append(export_cache._sum(tmp_path))
    assert len(set(sums)) == 3 and sums[2] == sums[3]


@pytest.mark.parametrize("damage", [b"", b"no pickle", "half"])
def test_a_damaged_file_is_made_anew(cache, counted, damage):
    make, calls = counted
    make()(*arguments())
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if damage == "half" else damage)
    with pytest.warns(UserWarning, match="cannot be read"):
        assert_solved(make()(*arguments()))
    assert len(calls) == 2 and file.stat().st_size == len(whole)
    assert_solved(make()(*arguments()))
    assert len(calls) == 2


def test_a_cache_that_cannot_be_written_is_none(cache, counted):
    make, _ = counted
    cache.write_text("in the way")
    with pytest.warns(UserWarning, match="not kept"):
        assert_solved(make()(*arguments()))


@pytest.mark.parametrize("other", [None, "gs://bucket/cache"])
def test_without_a_cache_on_disk_it_is_a_jitted_function(cache, counted, tmp_path, monkeypatch, other):
    make, calls = counted
    monkeypatch.chdir(tmp_path)
    jax.config.update(export_cache.CACHE, other)
    kept = make()
    for _ in range(2):
        assert_solved(kept(*arguments()))
    assert len(calls) == 1 and not list(tmp_path.iterdir())


def test_within_another_function_it_is_traced_along(cache, counted):
    """So it can be mapped and differentiated, which a program that was read cannot."""
    make, _ = counted
    places, used = arguments()
    slope = jax.jit(jax.grad(lambda used: jnp.sum(make()(places, used)[0]["x"])))(used)
    inverse = np.linalg.inv(np.linalg.cholesky(np.asarray(places["A"] @ places["A"].T) + np.eye(2)))
    np.testing.assert_allclose(slope, inverse.sum(axis=0), rtol=1e-12)
    assert not cache.exists()


def test_what_is_used_up_is_gone_and_the_rest_is_not(cache, counted):
    make, _ = counted
    for kept in (make(), make()):
        places, used = arguments()
        kept(places, used)
        assert used.is_deleted() and not places["A"].is_deleted()


def test_crowds_are_dealt_out_wherever_their_arrays_are(cache):
    """Also by a program for two devices, whose arguments are on one of them, or on the host, or where it left them."""
    assert jax.local_device_count() == 2
    traces = []

    def stir(keys, x):
        traces.append(x.shape)
        return sharding.deal(lambda keys, x: (keys, x + jax.vmap(jax.random.uniform)(keys)), keys, x)

    keys = jax.random.split(jax.random.key(0), 4)
    drawn = np.asarray(jax.vmap(jax.random.uniform)(keys))
    for _ in range(2):
        kept = export_cache.Kept(stir, donated=("x",))
        for x in (np.zeros(4), jnp.zeros(4)):
            for turn in range(1, 4):
                keys, x = kept(keys, x)
                np.testing.assert_allclose(x, turn * drawn, rtol=1e-12)
            assert len(keys.sharding.device_set) == 2
        kept.lower(keys, np.zeros(4)).compile()
    assert len(traces) == 1


def test_its_program_can_be_lowered(cache, counted):
    make, _ = counted
    compiled = make().lower(*arguments(), power=2).compile()
    assert_solved(compiled(*arguments()), power=2)


OTHER = """
import jax
jax.config.update("jax_enable_x64", True)
from lgmdjax import traced

def solve(A):
    print("traced")
    return jax.numpy.linalg.cholesky(A)

print(traced.Kept(solve)(4.0 * jax.numpy.eye(2))[1, 1])
"""


def test_another_process_reads_it(tmp_path):
    """It has never lowered a call of LAPACK, of which it must know all the same."""
    how = {"env": os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}, "capture_output": True, "text": True}
    told = [subprocess.run([sys.executable, "-c", OTHER], check=True, **how) for _ in range(2)]
    assert [process.stdout.split() for process in told] == [["traced", "2.0"], ["2.0"]]
