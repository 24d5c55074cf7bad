"""A clock of the robot's time, which may run slower than wall-clock time."""

import time

from lgmdjax.errors import InputError

MIN_SPEED, MAX_SPEED = 0.01, 1.0


class Clock:
    """The robot's time since the clock was made.

    A slow clock helps a computer that cannot simulate the robot in real time: both processes then use the same
    `speed`. A real robot needs speed 1.

    Args:
        speed: seconds of the robot's time for each second of wall-clock time.
    """

    def __init__(self, speed: float = 1.0):
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise InputError(f"expected a --speed of {MIN_SPEED:g} to {MAX_SPEED:g}, got {speed:g}; choose another")
        self.speed = speed
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the robot's time [s]."""
        return (time.monotonic() - self._start) * self.speed

    def to_wall(self, duration: float) -> float:
        """Return the wall-clock duration [s] of a duration of the robot's time [s]; at least 0, as timeouts require."""
        return max(duration, 0.0) / self.speed
