"""Damaged entries of JAX's cache are thrown away and made anew, and give no other results."""

import subprocess
import sys
from pathlib import Path

import pytest
from jax._src.lru_cache import LRUCache

from lgmdjax.runtime.program_cache import CheckedCache

SCRIPT = """
import sys, jax, jax.numpy as jnp
from lgmdjax.runtime import program_cache
if sys.argv[2] == "checked":
    program_cache.protect()
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
print(float(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.arange(5.0))))
"""


def test_an_entry_is_read_as_it_was_written(tmp_path: Path) -> None:
    cache = CheckedCache(LRUCache(str(tmp_path), max_size=-1))
    cache.put("key", b"machine code")
    assert cache.get("key") == b"machine code"
    assert cache.get("other") is None
    LRUCache(str(tmp_path), max_size=-1).put("plain", b"of JAX alone")
    assert cache.get("plain") == b"of JAX alone"


def test_every_damaged_byte_is_noticed(tmp_path: Path) -> None:
    cache = CheckedCache(LRUCache(str(tmp_path), max_size=-1))
    path = tmp_path / "key-cache"
    cache.put("key", b"machine code")
    whole = path.read_bytes()
    for position in range(len(b"machine code")):
        damaged = bytearray(whole)
        damaged[position] ^= 4
        path.write_bytes(damaged)
        with pytest.warns(UserWarning, match="is damaged"):
            assert cache.get("key") is None
        assert not path.exists()
    path.write_bytes(whole[:5])  # as a killed process leaves it: JAX cannot decompress it
    cache.put("key", b"machine code")
    assert cache.get("key") == b"machine code"


@pytest.mark.parametrize("reader", ["checked", "plain"])
def test_jax_reads_what_was_written_with_checksums(tmp_path: Path, reader: str) -> None:
    def run(how: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path), how], capture_output=True, text=True)

    first = run("checked")
    entries = {path: path.read_bytes() for path in tmp_path.glob("*-cache")}
    assert entries and all(content[-39:-32] == b"sha256:" for content in entries.values()), first.stderr
    again = run(reader)
    assert again.stdout == first.stdout and "Error reading" not in again.stderr
    if reader == "checked":
        for path, content in entries.items():
            path.write_bytes(content[:40] + bytes([content[40] ^ 1]) + content[41:])
        healed = run("checked")
        assert healed.stdout == first.stdout and "is damaged" in healed.stderr
        assert {path: path.read_bytes()[-39:-32] for path in entries} == dict.fromkeys(entries, b"sha256:")
