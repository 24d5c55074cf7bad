"""A traced program is read from disk if it is the same, in this process or another, and traced again otherwise.

Files of the cache run no code: neither damaged nor hostile ones.
"""

import hashlib
import json
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from jax import export

from lgmdjax import minmax
from lgmdjax.runtime import export_cache
from lgmdjax.simulation import sharding

only_with_modes = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows has no modes of files")


@pytest.fixture
def cache(tmp_path):
    """An empty cache for one test; the value is the folder of traced programs in it."""
    before = getattr(jax.config, export_cache.CACHE_OPTION)
    jax.config.update(export_cache.CACHE_OPTION, str(tmp_path))
    yield tmp_path / "exported"
    jax.config.update(export_cache.CACHE_OPTION, before)


@pytest.fixture
def counted():
    """A function that makes cached functions, each as new as in a new process, and the list of their traces so far."""
    calls = []

    def solve(system, used, *, power=1):
        calls.append((system["A"].dtype, power))
        factor = jnp.linalg.cholesky(system["A"] @ system["A"].T + jnp.eye(2))
        return {"x": jnp.linalg.solve(factor, used) ** power, "key": jax.random.fold_in(system["key"], 1)}, used + 1

    return lambda: export_cache.cached_jit(solve, donate_argnames=("used",)), calls


def arguments(dtype=None):
    return {"A": jnp.array([[2.0, 1.0], [0.5, 3.0]], dtype), "key": jax.random.key(0)}, jnp.array([1.0, -2.0], dtype)


def assert_solved(found, power=1):
    A, b = jax.device_get(arguments()[0]["A"]), np.array([1.0, -2.0])
    factor = np.linalg.cholesky(A @ A.T + np.eye(2))
    np.testing.assert_allclose(found[0]["x"], np.linalg.solve(factor, b) ** power, rtol=1e-12)
    np.testing.assert_array_equal(found[1], b + 1)
    assert found[0]["key"] == jax.random.fold_in(jax.random.key(0), 1)


def test_is_traced_once(cache, counted):
    make, calls = counted
    for cached in (make(), make()):
        for _ in range(2):
            assert_solved(cached(*arguments()))
    assert len(calls) == 1
    (file,) = cache.iterdir()
    assert re.fullmatch(r"solve-[0-9a-f]{32}-[0-9a-f]{16}\.program", file.name)


def test_decorates_with_and_without_options():
    @export_cache.cached_jit
    def double(x):
        return 2 * x

    @export_cache.cached_jit(donate_argnames=("x",))
    def halve(x):
        """Halve a number."""
        return x / 2

    assert halve(double(jnp.ones(()))) == 1.0
    assert (halve.__name__, halve.__doc__) == ("halve", "Halve a number.")


def test_a_static_function_is_kept_only_if_the_package_has_it(cache):
    """Another's source may change; its program is compiled in memory alone, one for each function."""
    traces = []

    def apply(x, *, function):
        traces.append(function)
        return function(x, 2 * x)

    for _ in range(2):
        cached = export_cache.cached_jit(apply)
        assert cached(jnp.ones(()), function=minmax.maximum) == 2.0
    assert len(traces) == len(list(cache.iterdir())) == 1
    for own, expected in (((lambda a, b: a + b), 3.0), ((lambda a, b: a - b), -1.0)):
        assert cached(jnp.ones(()), function=own) == expected
    assert len(list(cache.iterdir())) == 1


def test_a_program_of_a_detector_is_kept_only_if_the_package_has_it(cache):
    """A static field of an argument: a module of the package, or one of the user, whose source may change unnoticed."""
    traces = []

    def gather(tagged):
        traces.append(tagged.label)
        return replace(tagged, number=2 * tagged.number)

    for label, kept in ((minmax, 1), (pytest, 1), (sharding, 2)):
        for _ in range(2):
            found = export_cache.cached_jit(gather)(Tagged(jnp.ones(()), label))
            assert found.label is label and found.number == 2.0
        assert len(list(cache.iterdir())) == kept
    assert traces == [minmax, pytest, pytest, sharding]


@struct.dataclass
class Tagged:
    """A number with a static label."""

    number: jax.Array
    label: object = struct.field(pytree_node=False)


class Pair(NamedTuple):
    first: jax.Array
    second: object


def test_static_fields_that_are_equal_are_the_same(cache):
    """The label of a result is read from disk: an equal string, but not the same object."""
    traces = []

    def add(a, b):
        traces.append(a.label)
        return replace(b, number=a.number + b.number)

    label = "-".join(["some", "words"])
    for _ in range(2):
        cached, a, b = export_cache.cached_jit(add), Tagged(jnp.ones(()), label), Tagged(jnp.ones(()), label)
        for _ in range(3):
            b = cached(a, b)
        assert b.number == 4 and b.label == label
    cached(replace(a, label="another"), b)
    assert traces == [label, "another"]


def test_results_keep_their_structure(cache):
    traces = []

    def gather(x, key):
        traces.append(x)
        nested = Pair(x, [None, (x + 1, Pair(x, {"a": Tagged(x, label="b")}))])
        return {"nested": nested, "key": jax.random.split(key), "empty": (), "none": None}

    x, key = jnp.arange(3.0), jax.random.key(1)
    expected = gather(x, key)
    for _ in range(2):
        found = export_cache.cached_jit(gather)(x, key)
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), found, expected))
        assert found["nested"].second[1][1].second["a"].label == "b"
    assert len(traces) == 2  # one is ours


def test_results_that_are_no_data_are_not_cached(cache):
    @struct.dataclass
    class Local:
        number: jax.Array

    def wrap(x):
        return Local(number=x)

    for _ in range(2):
        with pytest.warns(UserWarning, match="not cached"):
            assert export_cache.cached_jit(wrap)(jnp.ones(())).number == 1.0
    assert not list(cache.iterdir())


def test_a_program_that_calls_python_is_not_cached(cache):
    def call_back(x):
        return jax.pure_callback(lambda x: x + 1, x, x)

    with pytest.warns(UserWarning, match="not cached"):
        assert export_cache.cached_jit(call_back)(jnp.ones(())) == 2.0
    assert not list(cache.iterdir())


@pytest.mark.parametrize("target", ["xla_ffi_python_cpu_callback", "mosaic_gpu_v2", "my lapack_potrf"])
def test_a_stored_program_may_not_call_other_code(target):
    """A file could hold a program that we would not have written."""
    allowed = [export.DisabledSafetyCheck.custom_call(target)]
    foreign = jax.jit(lambda x: jax.ffi.ffi_call(target, jax.ShapeDtypeStruct((), float))(x))
    with pytest.raises(ValueError, match=f"outside of XLA .*{target}"):
        export_cache._check_calls(export.export(foreign, disabled_checks=allowed)(jnp.ones(())))


def test_is_traced_again_for_other_arguments_settings_and_releases(cache, counted, monkeypatch):
    make, calls = counted
    cached = make()
    for power in (1, 2):
        assert_solved(cached(*arguments(), power=power), power)
    cached(*arguments(jnp.float32))
    with jax.default_matmul_precision("highest"):
        cached(*arguments())
    with jax.threefry_partitionable(False):
        cached(*arguments())
    assert len(calls) == len(list(cache.iterdir())) == 5
    monkeypatch.setattr(export_cache, "PACKAGE_DIGEST", "edited")
    cached(*arguments())
    assert len(calls) == 6


def test_programs_of_other_releases_are_deleted(cache, counted, monkeypatch):
    """And nothing else that lies in the folder."""
    make, _ = counted
    for digest in ("first", "second"):
        monkeypatch.setattr(export_cache, "PACKAGE_DIGEST", digest)
        make()(*arguments())
        make()(*arguments(jnp.float32))
        (cache / "notes.txt").write_text("of the user")
        (cache / "solve.program").write_text("of the user")
    names = {file.name for file in cache.iterdir()}
    assert names >= {"notes.txt", "solve.program"} and len(names) == 4
    assert sum(export_cache._release() in name for name in names) == 2


def test_functions_of_one_name_are_two(cache):
    def more():
        def solve(x):
            return x + 1

        return solve

    def less():
        def solve(x):
            return x - 1

        return solve

    assert [float(export_cache.cached_jit(make())(jnp.ones(()))) for make in (more, less)] == [2.0, 0.0]


def test_the_package_is_known_by_every_byte(tmp_path):
    (tmp_path / "__pycache__").mkdir()
    sums = []
    for name, content in (("a.py", "1"), ("a.py", "2"), ("b.py", "2"), ("__pycache__/a.pyc", "3")):
        (tmp_path / name).write_text(content)
        sums.append(export_cache.hash_folder(tmp_path))
    assert len(set(sums)) == 3 and sums[2] == sums[3]


class Exploit:
    """What pickle would load by running a command."""

    def __reduce__(self):
        return os.system, ("touch exploited",)


def with_checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode() + b"\n" + content


def edited(whole: bytes, **changes) -> bytes:
    """A file whose header says something else, and whose checksum is right."""
    _, header, program = whole.split(b"\n", 2)
    return with_checksum(json.dumps(json.loads(header) | changes).encode() + b"\n" + program)


HOSTILE = {"dataclass": ["subprocess:Popen", {"args": "touch exploited", "shell": True}]}
DAMAGE = {
    "empty": lambda _: b"",
    "text": lambda _: b"no program",
    "half": lambda whole: whole[: len(whole) // 2],
    "one bit": lambda whole: whole[:-1] + bytes([whole[-1] ^ 1]),
    "checksum": lambda whole: b"0" * 64 + whole[64:],
    "pickle": lambda _: pickle.dumps(Exploit()),
    "pickle with a checksum": lambda _: with_checksum(pickle.dumps(Exploit())),
    "another program": lambda whole: edited(whole, key="0" * 32),
    "another version": lambda whole: edited(whole, version=1),
    "no version": lambda _: with_checksum(b"{}\n"),
    "fewer results": lambda whole: edited(whole, results={"leaf": None}),
    "a class to call": lambda whole: edited(whole, results=HOSTILE),
    "no StableHLO": lambda whole: with_checksum(b"\n".join([whole.split(b"\n", 2)[1], b"text"])),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_made_again_and_runs_nothing(cache, counted, tmp_path, monkeypatch, damage):
    monkeypatch.chdir(tmp_path)
    make, calls = counted
    make()(*arguments())
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(DAMAGE[damage](whole))
    with pytest.warns(UserWarning, match="cannot be read .*; it is deleted and made again"):
        assert_solved(make()(*arguments()))
    assert len(calls) == 2 and file.stat().st_size == len(whole)
    assert_solved(make()(*arguments()))
    assert len(calls) == 2 and not Path("exploited").exists()


def test_files_of_version_0_1_0_are_not_read(cache, counted, tmp_path, monkeypatch):
    """They are pickles, in another folder."""
    monkeypatch.chdir(tmp_path)
    make, calls = counted
    make()(*arguments())
    (file,) = cache.iterdir()
    old = tmp_path / "traced" / f"{file.name[: len('solve-') + 32]}.pickle"
    old.parent.mkdir()
    old.write_bytes(pickle.dumps((b"", Exploit())))
    file.unlink()
    assert_solved(make()(*arguments()))
    assert len(calls) == 2 and not Path("exploited").exists()


@only_with_modes
def test_folder_and_files_belong_to_their_owner_alone(cache, counted):
    make, _ = counted
    before = os.umask(0)
    try:
        make()(*arguments())
    finally:
        os.umask(before)
    (file,) = cache.iterdir()
    assert (cache.stat().st_mode & 0o777, file.stat().st_mode & 0o777) == (0o700, 0o600)


@only_with_modes
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_folder_that_others_may_write_to_is_not_used(cache, counted, mode):
    make, calls = counted
    make()(*arguments())
    cache.chmod(mode)
    with pytest.warns(UserWarning, match="not cached: .*writable by its owner alone.*JAX_COMPILATION_CACHE_DIR"):
        assert_solved(make()(*arguments()))
    assert len(calls) == 2
    assert len(list(cache.iterdir())) == 1


@only_with_modes
def test_a_folder_of_another_user_is_not_used(cache, counted, monkeypatch):
    make, calls = counted
    make()(*arguments())
    monkeypatch.setattr(os, "getuid", lambda: cache.stat().st_uid + 1)
    with pytest.warns(UserWarning, match="not cached: .*owned by this user"):
        assert_solved(make()(*arguments()))
    assert len(calls) == 2


@only_with_modes
def test_a_file_that_others_may_write_to_is_made_again(cache, counted):
    make, calls = counted
    make()(*arguments())
    (file,) = cache.iterdir()
    file.chmod(0o622)
    with pytest.warns(UserWarning, match="cannot be read .*writable by its owner alone"):
        assert_solved(make()(*arguments()))
    assert len(calls) == 2 and file.stat().st_mode & 0o777 == 0o600


def test_without_a_writable_cache_nothing_is_cached(cache, counted):
    make, _ = counted
    cache.write_text("a file in place of the folder")
    with pytest.warns(UserWarning, match="not cached"):
        assert_solved(make()(*arguments()))


@pytest.mark.parametrize("other", [None, "gs://bucket/cache"])
def test_without_a_cache_on_disk_it_is_a_jitted_function(cache, counted, tmp_path, monkeypatch, other):
    make, calls = counted
    monkeypatch.chdir(tmp_path)
    jax.config.update(export_cache.CACHE_OPTION, other)
    cached = make()
    for _ in range(2):
        assert_solved(cached(*arguments()))
    assert len(calls) == 1 and not list(tmp_path.iterdir())


def test_inside_another_traced_function_it_is_traced_too(cache, counted):
    """So it can be mapped and differentiated, as a program that was read cannot."""
    make, _ = counted
    system, used = arguments()
    gradient = jax.jit(jax.grad(lambda used: jnp.sum(make()(system, used)[0]["x"])))(used)
    inverse = np.linalg.inv(np.linalg.cholesky(np.asarray(system["A"] @ system["A"].T) + np.eye(2)))
    np.testing.assert_allclose(gradient, inverse.sum(axis=0), rtol=1e-12)
    assert not cache.exists()


def test_donated_arguments_are_deleted_and_others_are_not(cache, counted):
    make, _ = counted
    for cached in (make(), make()):
        system, used = arguments()
        cached(system, used)
        assert used.is_deleted() and not system["A"].is_deleted()


def test_robots_are_sharded_wherever_their_arrays_are(cache):
    """Also by a program for two devices, whose arguments are on one of them, or on the host, or where it left them."""
    assert jax.local_device_count() == 2
    traces = []

    def stir(keys, x):
        traces.append(x.shape)
        return sharding.shard_robots(lambda keys, x: (keys, x + jax.vmap(jax.random.uniform)(keys)), keys, x)

    keys = jax.random.split(jax.random.key(0), 4)
    added = np.asarray(jax.vmap(jax.random.uniform)(keys))
    for _ in range(2):
        cached = export_cache.cached_jit(stir, donate_argnames=("x",))
        for x in (np.zeros(4), jnp.zeros(4)):
            for turn in range(1, 4):
                keys, x = cached(keys, x)
                np.testing.assert_allclose(x, turn * added, rtol=1e-12)
            assert len(keys.sharding.device_set) == 2
        cached.lower(keys, np.zeros(4)).compile()
    assert len(traces) == 1


def test_its_program_can_be_lowered(cache, counted):
    make, _ = counted
    compiled = make().lower(*arguments(), power=2).compile()
    assert_solved(compiled(*arguments()), power=2)


OTHER = """
import jax
jax.config.update("jax_enable_x64", True)
from lgmdjax import minmax
from lgmdjax.runtime import export_cache

def solve(A):
    print("traced")
    return jax.numpy.linalg.cholesky(A)

print(export_cache.cached_jit(solve)(4.0 * jax.numpy.eye(2))[1, 1])
"""


def test_another_process_reads_it(tmp_path):
    """It has never lowered a call of LAPACK, whose address it must know all the same."""
    how = {"env": os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}, "capture_output": True, "text": True}
    processes = [subprocess.run([sys.executable, "-c", OTHER], check=True, **how) for _ in range(2)]
    assert [process.stdout.split() for process in processes] == [["traced", "2.0"], ["2.0"]]
