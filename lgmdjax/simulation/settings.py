"""Settings of the rooms in which studies compare robots."""

from dataclasses import dataclass

from lgmdjax.sensors.settings import CameraSettings


@dataclass(frozen=True, kw_only=True)
class BenchmarkRooms:
    """The rooms in which a study compares robots: as many, for as long."""

    eyes: CameraSettings
    robots: int
    seconds: float
