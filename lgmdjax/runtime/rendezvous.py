"""Processes of one run find each other before JAX connects them.

JAX's coordinator ends a process without an exception if another one is late, missing or there twice. So all processes
first meet here, at the coordinator's address, over plain TCP. Each of them says in one line of JSON which process it
is; process 0 answers all of them at once with `GO`, or one of them with the reason why it can't take part. Process 0
then gives the port to JAX.
"""

import contextlib
import json
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass

from lgmdjax import __version__
from lgmdjax.errors import InputError, one_line

GO = "go"
MAX_LINE = 4096  # bytes
PAUSE = 0.2  # s between two attempts to connect
REPLY_SECONDS = 10.0  # within which a process that has connected says its number
LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True, kw_only=True)
class Member:
    """What a process says about itself; all but `process` must be the same in every process."""

    process: int  # its number, from 0
    processes: int  # how many there are
    task: str  # the command and the run
    version: str = __version__


def meet(address: str, member: Member, seconds: float) -> None:
    """Return when all processes have met at `address`, which is HOST:PORT of process 0.

    Raises `InputError` in every process that can't take part, and in all of them if one is still missing after
    `seconds`.
    """
    host, port = split_address(address)
    if member.process == 0:
        with contextlib.closing(_listen(host, port)) as server:
            _gather(server, member, time.monotonic() + seconds, seconds)
    else:
        _report(host, port, member, time.monotonic() + seconds, seconds)


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT; raise `InputError` for any other text.

    >>> split_address("node1:9000"), split_address("[::1]:9000")
    (('node1', 9000), ('::1', 9000))
    """
    host, _, port = address.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and 0 < int(port) < 2**16):
        raise InputError(f"expected --coordinator HOST:PORT, got {address!r}; name a free port of process 0's machine")
    return host.strip("[]"), int(port)


def bind_address(address: str) -> str:
    """Return where JAX's coordinator listens: on all networks, but on none if the address is of this machine alone.

    >>> bind_address("127.0.0.1:9000"), bind_address("node1:9000")
    ('127.0.0.1:9000', '[::]:9000')
    """
    host, port = split_address(address)
    return address if host in LOOPBACK else f"[::]:{port}"


def _listen(host: str, port: int) -> socket.socket:
    try:
        if host in LOOPBACK:
            return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        if socket.has_dualstack_ipv6():
            return socket.create_server(("", port), family=socket.AF_INET6, dualstack_ipv6=True)
        return socket.create_server(("", port))
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"expected a free port {port} for process 0, got one that can't be opened ({reason}); end the other "
            "process 0, or choose another port"
        ) from error


def _gather(server: socket.socket, own: Member, deadline: float, seconds: float) -> None:
    """Wait for all other processes, then let all of them go."""
    present: dict[int, socket.socket] = {}
    try:
        while len(present) < own.processes - 1 and (left := deadline - time.monotonic()) > 0:
            server.settimeout(left)
            with contextlib.suppress(TimeoutError):
                _admit(server.accept()[0], own, present)
        missing = sorted(set(range(1, own.processes)) - present.keys())
        names = ", ".join(map(str, missing[:8])) + " and others" * (len(missing) > 8)
        fault = (
            f"expected {own.processes} processes within {seconds:g} s, got none with number {names}; "
            "start all with the same --processes"
        )
        for connection in present.values():
            _answer(connection, fault if missing else GO)
        if missing:
            raise InputError(fault)
    finally:
        for connection in present.values():
            _close_last(connection)


def _admit(connection: socket.socket, own: Member, present: dict[int, socket.socket]) -> None:
    """Add a process that has connected to those that are present, or tell it why not."""
    connection.settimeout(REPLY_SECONDS)
    try:
        with connection.makefile("rb") as stream:
            member = json.loads(stream.readline(MAX_LINE))
    except (OSError, ValueError, RecursionError):
        connection.close()  # no process of ours
        return
    fault = _find_fault(member, own, present)
    if fault:
        _answer(connection, fault)
        connection.close()
    else:
        present[member["process"]] = connection


def _find_fault(member: object, own: Member, present: dict[int, socket.socket]) -> str:
    """Return why a process can't take part; an empty text if it can. Forget a process that has gone."""
    if not isinstance(member, Mapping):
        return "expected a process of lgmdjax, got something else"
    for name, value in (("version", own.version), ("task", own.task), ("processes", own.processes)):
        if member.get(name) != value:
            found = member.get(name)
            return f"expected {name} {value} as in process 0, got {found}; start all processes with the same flags"
    number = member.get("process")
    if not isinstance(number, int) or not 0 < number < own.processes:
        return f"expected a --process of 1 to {own.processes - 1}, got {number}; number the processes from 0"
    if number in present and not _has_gone(present[number]):
        return f"expected one process of number {number}, got two; give each process its own --process"
    if number in present:
        present.pop(number).close()
    return ""


def _has_gone(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1, socket.MSG_PEEK) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
    finally:
        connection.settimeout(REPLY_SECONDS)


def _answer(connection: socket.socket, text: str) -> None:
    with contextlib.suppress(OSError):
        connection.sendall(f"{text}\n".encode())


def _close_last(connection: socket.socket) -> None:
    """Close a connection after the other side, so that the port is free at once."""
    with contextlib.suppress(OSError):
        connection.recv(1)
    connection.close()


def _report(host: str, port: int, own: Member, deadline: float, seconds: float) -> None:
    """Tell process 0 that this process is there, and wait until it lets all go."""
    with _connect(host, port, deadline, seconds) as connection:
        try:
            connection.sendall(json.dumps(asdict(own)).encode() + b"\n")
            connection.settimeout(max(deadline - time.monotonic(), 0) + REPLY_SECONDS)
            with connection.makefile("rb") as stream:
                answer = stream.readline(MAX_LINE).decode(errors="replace").strip()
        except OSError as error:
            answer = one_line(error)
    if answer.startswith("expected"):
        raise InputError(answer)
    if answer != GO:
        found = "another service" if answer else "none"
        raise InputError(
            f"expected process 0 to wait for processes at {host}:{port}, got {found}; "
            f"if the run is already going, it has another process of number {own.process}: give each its own --process"
        )


def _connect(host: str, port: int, deadline: float, seconds: float) -> socket.socket:
    while True:
        left = deadline - time.monotonic()
        try:
            return socket.create_connection((host, port), timeout=max(left, PAUSE))
        except OSError as error:
            if left <= PAUSE:
                raise InputError(
                    f"expected process 0 at {host}:{port} within {seconds:g} s, got none ({error.strerror or error}); "
                    "start process 0 there, or check --coordinator and the firewall"
                ) from error
        time.sleep(PAUSE)
