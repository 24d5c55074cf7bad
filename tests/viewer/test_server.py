"""The viewer's server: one address, pages of its own alone, one line for what cannot be had."""

import asyncio
import re
import socket
from collections.abc import Iterator

import pytest
import viser
import websockets
from websockets.asyncio.client import connect

from lgmdjax.errors import InputError
from lgmdjax.viewer import markdown
from lgmdjax.viewer import server as web


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = web.start("127.0.0.1", 0)
    yield started
    started.stop()


def first_message(server: viser.ViserServer, origin: str | None, name: str = "127.0.0.1") -> bytes | int:
    """Connect as a page of some Origin; return the first message, or the code with which the connection is closed."""

    async def ask() -> bytes | int:
        headers = {"Host": f"{name}:{server.get_port()}"} if name != "127.0.0.1" else None
        async with connect(
            f"ws://127.0.0.1:{server.get_port()}",
            origin=None if origin is None else websockets.Origin(origin),
            subprotocols=[websockets.Subprotocol(f"viser-v{viser.__version__}")],
            additional_headers=headers,
        ) as page:
            try:
                message = await asyncio.wait_for(page.recv(), 20)
            except websockets.ConnectionClosed as closed:
                return closed.rcvd.code if closed.rcvd else 0
            assert isinstance(message, bytes)
            return message

    return asyncio.run(ask())


def test_pages_of_other_origins_get_nothing(server):
    port = server.get_port()
    for origin in ("http://evil.example", f"http://evil.example:{port}", "http://127.0.0.1:1", "null"):
        assert first_message(server, origin) == web.POLICY_VIOLATION
    assert isinstance(first_message(server, f"http://127.0.0.1:{port}"), bytes)
    assert isinstance(first_message(server, None), bytes)


def test_a_name_that_was_rebound_to_this_machine_is_no_own_origin():
    assert not web.is_own_origin("http://evil.example:8080", "evil.example:8080", "127.0.0.1")
    assert web.is_own_origin("http://robot.lab:8080", "robot.lab:8080", "0.0.0.0")
    assert not web.is_own_origin("http://evil.example", "robot.lab:8080", "0.0.0.0")
    assert web.is_own_origin("http://[::1]:8080", "[::1]:8080", "::1")


def test_it_listens_on_the_loopback_address_alone(server):
    assert web.address(server) == f"http://127.0.0.1:{server.get_port()}"
    listening = server._websock_server._port
    with socket.socket() as other:
        other.bind(("127.0.0.2", listening))  # free, unless the server listens on all addresses


OUTSIDE = (
    "/../../../../../../../../etc/passwd",
    "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/..%2f..%2f..%2f..%2f..%2f..%2f..%2f..%2fetc/passwd",
    "/..%5c..%5c..%5cetc%5cpasswd",
    "//etc/passwd",
    "/etc/passwd",
    "/file:///etc/passwd",
    "http://127.0.0.1/etc/passwd",
    "/index.html/../../../../../../../../../etc/passwd",
    "/assets/..%00/etc/passwd",
    "/__init__.py",
    "/../__init__.py",
)


@pytest.mark.parametrize("path", OUTSIDE)
def test_no_file_outside_of_the_page_is_served(server, path):
    """Asked byte by byte, since a client library would tidy the path up first."""
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=20) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.get_port()}\r\n\r\n".encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 404 ") and len(answer) < 1000


HOSTILE = (
    "<script>alert(1)</script>",
    "<iframe srcdoc='<script>alert(1)</script>'>",
    "![x](/etc/hostname.png)",
    "![x](http://example.org/x.png)",
    "[here](javascript:alert(1))",
    "`a` *b* _c_ {d} ~e~ \\ & # + - .",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_names_on_the_page_are_text(server, text, monkeypatch):
    """viser renders HTML in Markdown, and its server reads the pictures that Markdown names."""
    monkeypatch.setattr(viser._gui_handles, "_get_data_url", lambda *_: pytest.fail("a picture is read"))
    shown = server.gui.add_markdown(markdown.bold(f"line\n{text}"))._markdown
    assert shown.startswith("**") and shown.endswith("**") and "\n" not in shown
    unescaped = re.sub(r"\\([!-/:-@\[-`{-~])", "", shown[2:-2])
    assert not re.search(r"[!-/:-@\[-`{-~]", unescaped)  # every mark has a backslash of its own
    assert re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", shown[2:-2]) == f"line {text}"


def test_a_port_or_an_address_that_cannot_be_had_is_one_line(server):
    with pytest.raises(InputError, match=r"expected a free port, got \d+, which is in use; .*--port 0"):
        web.start("127.0.0.1", server.get_port())
    for port in (-1, 65536):
        with pytest.raises(InputError, match="expected a --port of 0 to 65535"):
            web.start("127.0.0.1", port)
    for host in ("203.0.113.7", "no.such.host.invalid"):
        with pytest.raises(InputError, match="expected an address of this machine"):
            web.start(host, 0)


def test_without_a_browser_a_line_says_so(server, monkeypatch):
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    assert "no browser" in web.open_page(server)


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("lgmdjax.reporting.walk_scene.HAS_VISER", False)
    with pytest.raises(InputError, match=r"pip install 'lgmdjax\[viewer\]'"):
        web.start("127.0.0.1", 0)
