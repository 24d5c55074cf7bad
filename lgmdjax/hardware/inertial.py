"""Detect a fall with an inertial sensor on a serial port, which sends a line of three numbers for each sample.

A line holds the acceleration in the trunk's frame (x forward, y left, z up), separated by blanks or commas, in any
unit: only its direction matters. At rest, upright, it is (0, 0, +1). Lines that are not three numbers are ignored.
"""

import contextlib
import math
import os
import termios
import tty

import numpy as np
from jaxtyping import Float

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError

SMOOTHING = 0.3  # s, time constant for the acceleration, since steps shake the trunk
MAX_LINE = 200  # bytes


class InertialSensor:
    """An open port; use it in a `with` block. Raises InputError if it cannot be opened."""

    def __init__(self, port: str):
        try:
            self._file = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
            with contextlib.suppress(termios.error):  # a pipe is not a terminal
                tty.setraw(self._file)
        except OSError as error:
            raise InputError(f"expected an inertial sensor, got {port} ({error.strerror}); check it") from error
        self._bytes, self._time = b"", 0.0
        self._mean: Float[np.ndarray, 3] | None = None

    def __enter__(self) -> "InertialSensor":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def has_fallen(self, time: float) -> bool:
        """Read new samples; return whether the trunk is tilted so far that the robot must have fallen.

        Args:
            time: present time [s].
        """
        with contextlib.suppress(OSError):  # nothing new, or the sensor was unplugged
            self._bytes += os.read(self._file, 4096)
        *lines, self._bytes = self._bytes[-4096:].split(b"\n")
        self._bytes = self._bytes[-MAX_LINE:]
        for sample in filter(None, map(parse, lines)):
            weight = 1.0 if self._mean is None else 1 - math.exp(-(time - self._time) / SMOOTHING)
            self._time = time
            before = np.zeros(3) if self._mean is None else self._mean
            self._mean = before + weight * (np.array(sample) - before)
        return self._mean is not None and is_fallen(self._mean)


def parse(line: bytes) -> tuple[float, float, float] | None:
    """Return the three numbers of a line; None if it holds something else.

    >>> parse(b"0.1, -0.2 9.8"), parse(b"hello")
    ((0.1, -0.2, 9.8), None)
    """
    try:
        x, y, z = (float(word) for word in line.replace(b",", b" ").split())
    except ValueError:
        return None
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) and (x, y, z) != (0, 0, 0) else None


def is_fallen(acceleration: Float[np.ndarray, "3"]) -> bool:
    """Return whether the trunk is tilted by more than `hexapod.MIN_UPRIGHT` allows."""
    length = float(np.linalg.norm(acceleration))
    return length > 0 and float(acceleration[2]) / length < hexapod.MIN_UPRIGHT
