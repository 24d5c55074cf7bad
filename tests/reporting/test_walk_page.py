"""A walk as one HTML page: what the page embeds is the walk."""

import base64
import re

import msgspec
import numpy as np
import pytest
import synthetic
import zstandard

from lgmdjax.errors import InputError
from lgmdjax.reporting import walk_page

FRAMES = 60


@pytest.fixture(scope="module")
def page() -> walk_page.WalkPage:
    contact = np.zeros((2, FRAMES), bool)
    contact[0, 20:25] = True
    return walk_page.walk_page(synthetic.walk(2, FRAMES, contact=contact), synthetic.room(), index=0, seconds=2.0)


def embedded(page: walk_page.WalkPage) -> dict:
    """Return the recording that a page embeds."""
    packed = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page.html)
    assert packed is not None
    content = base64.b64decode(packed[1])
    inner = zstandard.ZstdDecompressor().decompress(content[8:], int.from_bytes(content[:8], "little"))
    return msgspec.msgpack.decode(inner[8 : 8 + int.from_bytes(inner[:8], "little")])


def test_the_page_embeds_the_whole_walk(page):
    recording = embedded(page)
    assert recording["durationSeconds"] == pytest.approx(FRAMES / 30)
    names = {message.get("name") for _, message in recording["messages"]}
    assert {"/world/contacts/0", "/world/floor", "/world/obstacles/0", "/world/paths/0"} <= names
    assert "/world/obstacles/5" not in names  # padding is not drawn
    times = sorted({time for time, _ in recording["messages"]})
    np.testing.assert_allclose(np.diff(times), walk_page.STRIDE / 30, atol=1e-6)


def test_the_page_needs_no_other_file(page, tmp_path):
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=[\"']?(https?:)?//", page.html)
    path = page.write(tmp_path / "walk.html")
    assert path.read_text(encoding="utf-8") == page.html and path.stat().st_size < 2e6


def test_a_notebook_shows_the_page_inline(page):
    inline = page._repr_html_()
    assert inline.startswith("<iframe srcdoc=") and "<script>" not in inline and "&lt;script&gt;" in inline


def test_bad_arguments_are_one_line(unchecked):
    record, room = synthetic.walk(2, FRAMES), synthetic.room()
    for bad in ({"index": 2}, {"seconds": 0.0}, {"seconds": 1e9}):
        with pytest.raises(InputError, match="expected"):
            walk_page.walk_page(record, room, **bad)  # pyright: ignore[reportArgumentType]
