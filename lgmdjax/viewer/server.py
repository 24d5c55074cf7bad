"""The viewer's web server: viser on one address, for its own pages only.

viser serves one page and one WebSocket, and does not check the Origin header: any page open in the same browser could
connect, press buttons and read the pictures. Therefore a connection whose Origin differs from the requested address is
closed before anything is sent (`is_own_origin`); programs other than browsers send no Origin. While the server listens
on the loopback address, host names other than this machine's are refused, so an attacker cannot point a name to it (DNS
rebinding).
"""

import errno
import socket
import webbrowser
from urllib.parse import urlsplit

from lgmdjax.errors import InputError
from lgmdjax.reporting import walk_scene
from lgmdjax.reporting.walk_scene import HAS_VISER

if HAS_VISER:
    import viser

LOOPBACK = ("127.0.0.1", "::1", "localhost")
ANY = ("0.0.0.0", "::")
POLICY_VIOLATION = 1008  # code with which a WebSocket is closed (RFC 6455)


def start(host: str, port: int) -> "viser.ViserServer":
    """Start the server; raise `InputError` for a port or an address that is not available.

    Args:
        host: address to listen on.
        port: port to listen on; 0 takes a free one.
    """
    walk_scene.check_installed()
    _require_free(host, port)
    server = walk_scene.quiet_server(host, port, "lgmdjax")
    _refuse_other_origins(server, host)
    server.gui.configure_theme(
        control_width="large", show_logo=False, show_share_button=False, brand_color=(0, 90, 150)
    )
    return server


def address(server: "viser.ViserServer") -> str:
    """Return the address of the page."""
    host = server.get_host()
    named = "localhost" if host in ANY else f"[{host}]" if ":" in host else host
    return f"http://{named}:{server.get_port()}"


def open_page(server: "viser.ViserServer") -> str:
    """Open the page in a browser, if there is one; return a line about it."""
    try:
        opened = webbrowser.open(address(server))
    except webbrowser.Error:
        opened = False
    return "opened in the browser" if opened else "no browser found here; open the address in one"


def is_own_origin(origin: str | None, asked: str, host: str) -> bool:
    """Return whether a page with this Origin may connect.

    >>> is_own_origin("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1")
    True
    >>> is_own_origin("http://evil.example", "127.0.0.1:8080", "127.0.0.1")
    False
    >>> is_own_origin("http://evil.example:8080", "evil.example:8080", "127.0.0.1")
    False

    Args:
        origin: the header Origin; None for a program that is not a browser.
        asked: the header Host.
        host: address that the server listens on.
    """
    if origin is None:
        return True
    try:
        page = urlsplit(origin)
        name = page.hostname or ""
    except ValueError:
        return False
    known = name in LOOPBACK or name == host or host not in LOOPBACK
    return page.netloc == asked and known


def _refuse_other_origins(server: "viser.ViserServer", host: str) -> None:
    sockets = server._websock_server  # viser has no public way to look at a connection before it answers

    async def check(connection: object) -> None:
        peer = sockets._live_connections[connection.client_id]  # type: ignore[attr-defined]
        headers = peer.request.headers if peer.request is not None else {}
        if not is_own_origin(headers.get("Origin"), headers.get("Host", ""), host):
            await peer.close(POLICY_VIOLATION, "expected a page of this server")

    sockets.on_client_connect(check)  # type: ignore[arg-type]


def _require_free(host: str, port: int) -> None:
    """Raise `InputError` unless the port is free: viser would silently take the next one."""
    if not 0 <= port <= 65535:
        raise InputError(f"expected a --port of 0 to 65535, got {port}; 8080 is the default, 0 takes a free one")
    try:
        family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except PermissionError:
        raise InputError(f"expected a --port that you may use, got {port}; choose one from 1024 on") from None
    except socket.gaierror as error:
        raise InputError(f"expected an address of this machine as --host, got {host}: {error.strerror}") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            reason = f"expected a free port, got {port}, which is in use; stop its program, or choose another: --port 0"
            raise InputError(reason) from None
        raise InputError(f"expected an address of this machine as --host, got {host}: {error.strerror}") from None
