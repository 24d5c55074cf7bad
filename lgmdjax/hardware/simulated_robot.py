"""A simulated robot to drive: servos on a pseudo-terminal, eyes as a stream of pictures, a body in a room.

The process serves three things to any program:

| what            | where               | as                                                    |
| --------------- | ------------------- | ----------------------------------------------------- |
| servos          | a pseudo-terminal   | AX-12A, Protocol 1.0 (`simulated_servos`)             |
| eyes            | a port of 127.0.0.1 | uncompressed pictures side by side (YUV4MPEG2), 30 Hz |
| inertial sensor | a pseudo-terminal   | a line of three numbers for each picture (`inertial`) |

All of them use one clock. If the computer is too slow for it, the clock is set back.
"""

import contextlib
import os
import select
import socket
import tty
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TextIO

import av
import jax
import numpy as np
from av.container import OutputContainer
from av.error import FFmpegError
from jaxtyping import UInt8

from lgmdjax.body import hexapod
from lgmdjax.hardware import ax_servo
from lgmdjax.hardware.clock import Clock
from lgmdjax.hardware.faults import ActiveFaults
from lgmdjax.hardware.simulated_body import Body
from lgmdjax.hardware.simulated_servos import ServoBank
from lgmdjax.sensors import camera
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS
from lgmdjax.world import arena

STEP = 1 / (FRAME_RATE * SUBSTEPS)  # s
POLL, MAX_WAIT = 0.002, 0.05  # s of wall-clock time; longest wait while a picture is rendered, and else
MAX_LAG = 0.05  # s of physics to catch up at once; for a longer lag the clock is set back
BYTE_TIME = ax_servo.BITS_PER_BYTE / ax_servo.BAUD_RATE  # s
TRACE = ("time", "x", "y", "z", "upright", "touched", "torque", "pictures", *(f"joint_{j}" for j in range(18)))
"""Columns of the trace: s, m, cosine of the tilt, whether an obstacle was touched, numbers of servos with torque and of
pictures, rad."""


class Terminal:
    """A pseudo-terminal that stays open while programs connect and disconnect, and can be unplugged."""

    def __init__(self) -> None:
        self.file, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.file, False)
        self.name = os.ttyname(self._slave)
        self.is_open = True

    def read(self) -> bytes:
        """Return the bytes that arrived; empty if there are none."""
        with contextlib.suppress(OSError):
            return os.read(self.file, 4096)
        return b""

    def write(self, content: bytes) -> None:
        """Send bytes; drop them if the buffer is full."""
        with contextlib.suppress(OSError):
            os.write(self.file, content)

    def close(self) -> None:
        """Close both ends, as a pulled plug does."""
        if self.is_open:
            os.close(self.file)
            os.close(self._slave)
        self.is_open = False


class _Connection:
    """A socket as a file for FFmpeg, which sends all bytes of a write or fails."""

    def __init__(self, connection: socket.socket):
        self._connection = connection

    def write(self, content: bytes) -> int:
        """Send bytes; return their number."""
        self._connection.sendall(content)
        return len(content)


class PictureServer:
    """Sends pictures to all clients of a local port; a client that reads too slowly is disconnected.

    Args:
        port: port to listen on; any free one if 0.
    """

    def __init__(self, port: int):
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.setblocking(False)
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._clients: list[tuple[socket.socket, OutputContainer, av.VideoStream]] = []

    def send(self, picture: UInt8[np.ndarray, "height width"]) -> None:
        """Send a picture to all clients."""
        with contextlib.suppress(BlockingIOError):
            self._accept(*self._listener.accept(), picture.shape)
        for client in tuple(self._clients):
            connection, container, stream = client
            try:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
            except (OSError, FFmpegError):
                self._clients.remove(client)
                connection.close()

    def close(self) -> None:
        """Close all connections."""
        for connection, _, _ in self._clients:
            connection.close()
        self._listener.close()

    def _accept(self, connection: socket.socket, _: object, shape: tuple[int, ...]) -> None:
        connection.settimeout(0.02)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        container = av.open(_Connection(connection), "w", format="yuv4mpegpipe", options={"flush_packets": "1"})
        stream = container.add_stream("rawvideo", rate=round(FRAME_RATE))
        stream.height, stream.width = shape
        stream.pix_fmt = "gray"
        self._clients.append((connection, container, stream))


class Renderer:
    """Renders both eyes, side by side, on a background thread."""

    def __init__(self, room: arena.Arena, eye: camera.Params):
        self._render = partial(jax.jit(partial(_render, eye)), room)
        self._thread = ThreadPoolExecutor(1)
        self._pending: Future[np.ndarray] | None = None

    def compile(self, pose: hexapod.Pose) -> None:
        """Compile the renderer by rendering one picture."""
        self.start(pose)
        if self._pending is not None:
            self._pending.result()
        self._pending = None

    def start(self, pose: hexapod.Pose) -> None:
        """Start to render a picture from a pose of the trunk, unless another one is pending."""
        if self._pending is None:
            self._pending = self._thread.submit(lambda: np.asarray(self._render(pose)))

    def is_busy(self) -> bool:
        """Return whether a picture is pending: started, but not taken."""
        return self._pending is not None

    def take(self) -> UInt8[np.ndarray, "height width"] | None:
        """Return the finished picture; None if there is none."""
        if self._pending is None or not self._pending.done():
            return None
        picture, self._pending = self._pending.result(), None
        return picture


def _render(eye: camera.Params, room: arena.Arena, pose: hexapod.Pose) -> jax.Array:
    images = camera.render(eye, room, *hexapod.eye_poses(pose))
    grey = jax.numpy.clip(jax.numpy.round(images), 0, 255).astype(jax.numpy.uint8)
    return jax.numpy.concatenate([grey[0], grey[1]], axis=1)


@dataclass(kw_only=True)
class SimulatedRobot:
    """A simulated robot: its parts, which are open, and its state."""

    body: Body
    bank: ServoBank
    faults: ActiveFaults
    renderer: Renderer
    clock: Clock
    bus: Terminal
    inertial: Terminal
    eyes: PictureServer
    print_line: Callable[[str], None]  # prints a line for the user
    trace: TextIO | None = None
    time: float = 0.0  # s, of the physics
    pictures: int = 0  # sent so far
    touched: bool = False
    _steps: int = 0
    _lag: float = 0.0  # s, by which the clock was set back
    _command: bytes = b""  # an incomplete line
    _at_end: bool = False  # no more commands come
    _answers: deque[tuple[float, bytes]] = field(default_factory=deque)  # due time, bytes

    def now(self) -> float:
        """Return the robot's time [s]: that of the clock, less what it was set back."""
        return self.clock.now() - self._lag

    def run(self, seconds: float, commands: int | None) -> None:
        """Serve for some seconds; switch faults as the lines of an open file, `commands`, say, until its end."""
        self._lag = self.clock.now()
        while self.time < seconds:
            self.turn(None if self._at_end else commands)

    def turn(self, commands: int | None = None) -> None:
        """Catch up with the clock, send what is due, and wait for bytes or for the next step; arguments as in `run`."""
        self._advance()
        self._serve(commands)

    def close(self) -> None:
        """Close ports and files."""
        self.bus.close()
        self.inertial.close()
        self.eyes.close()

    def _advance(self) -> None:
        """Step the physics up to now; start a picture every `SUBSTEPS` steps."""
        behind = self.now() - self.time
        if behind > MAX_LAG:
            self._lag += behind - MAX_LAG
        while self.time + STEP <= self.now():
            self.faults.act(self.body, self.bank, self.time)
            self.body.step()
            self._steps += 1
            self.time = self._steps * STEP
            self.touched |= self.body.contacts().obstacle
            if self._steps % SUBSTEPS == 0:
                self.bank.shut_down()
                self.renderer.start(self.body.pose())
                self._report()

    def _serve(self, commands: int | None) -> None:
        """Send what is due, and wait for bytes until the next step is."""
        if (picture := self.renderer.take()) is not None and not self.faults.frames_stopped:
            self.eyes.send(picture)
            self.pictures += 1
        while self._answers and self._answers[0][0] <= self.now():
            self.bus.write(self._answers.popleft()[1])
        if not self.faults.plugged and self.bus.is_open:
            self.bus.close()
        due = min([self.time + STEP, *(time for time, _ in list(self._answers)[:1])])
        files = [self.bus.file] if self.bus.is_open else []
        listened = [*files, commands] if commands is not None else files
        longest = POLL if self.renderer.is_busy() else MAX_WAIT
        ready = select.select(listened, [], [], min(self.clock.to_wall(due - self.now()), longest))[0]
        if self.bus.is_open and self.bus.file in ready:
            self._answer(self.faults.garble(self.bus.read()))
        if commands is not None and commands in ready:
            self._execute(os.read(commands, 4096))

    def _execute(self, received: bytes) -> None:
        """Switch the faults that the complete lines name."""
        self._at_end = not received
        *lines, self._command = (self._command + received).split(b"\n")
        for line in lines:
            self.print_line(f"{self.time:.1f} s: {self.faults.switch(line.decode(errors='replace'))}")

    def _answer(self, received: bytes) -> None:
        """Queue the answers to bytes of the bus."""
        if self.faults.bus_cut:
            return
        time = self.now() + BYTE_TIME * len(received)
        for answer in self.bank.receive(received):
            time += answer.delay + BYTE_TIME * len(answer.content)
            self._answers.append((time, self.faults.garble(answer.content)))

    def _report(self) -> None:
        """Write a line of the trace and a sample of the inertial sensor."""
        x, y, z = self.body.acceleration()
        if self.inertial.is_open:
            self.inertial.read()
            self.inertial.write(f"{x:.3f} {y:.3f} {z:.3f}\n".encode())
        if self.trace is None:
            return
        position, upright = self.body.data.qpos[:3], z / np.linalg.norm([x, y, z])
        counts = int(self.touched), int(self.body.torques().sum()), self.pictures
        numbers = [self.time, *position, upright, *counts, *self.body.angles().reshape(18)]
        self.trace.write(",".join(f"{number:.6g}" for number in numbers) + "\n")
        self.trace.flush()
