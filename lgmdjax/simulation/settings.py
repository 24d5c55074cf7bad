"""Settings of the rooms in which studies compare robots."""

from dataclasses import dataclass

from lgmdjax.sensors.settings import Resolution


@dataclass(frozen=True, kw_only=True)
class BenchmarkRooms:
    """Rooms in which a study compares robots: how many, for how long, and with which camera."""

    eyes: Resolution
    robots: int
    seconds: float  # of robot time in each room
