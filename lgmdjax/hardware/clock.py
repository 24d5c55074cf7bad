"""A clock for the robot's time, which may run slower than the wall's."""

import time

from lgmdjax.errors import InputError

MIN_SPEED, MAX_SPEED = 0.01, 1.0


class Clock:
    """Seconds of the robot's time since it was made.

    A slow clock gives a computer that is busy with a simulated robot the time that it needs: both processes then take
    the same `speed`. A real robot has speed 1.

    Args:
        speed: seconds of the robot for each second of the wall.
    """

    def __init__(self, speed: float = 1.0):
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise InputError(f"expected a --speed of {MIN_SPEED:g} to {MAX_SPEED:g}, got {speed:g}; choose another")
        self.speed = speed
        self._start = time.monotonic()

    def now(self) -> float:
        """Return the time [s]."""
        return (time.monotonic() - self._start) * self.speed

    def to_wall(self, duration: float) -> float:
        """Return how long a duration of the robot [s] takes on the wall [s]; not negative, as timeouts need it."""
        return max(duration, 0.0) / self.speed
