"""Settings of the studies."""

from dataclasses import dataclass

from lgmdjax.learning.settings import TrainSettings
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation.settings import BenchmarkRooms


@dataclass(frozen=True, kw_only=True)
class VelocitySettings:
    """The eyes of a robot that walks straight on, at multiples of the nominal velocity, as far at each."""

    eyes: CameraSettings
    robots: int
    metres: float  # of each robot, at each velocity
    velocities: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0)


@dataclass(frozen=True, kw_only=True)
class SupervisionSettings:
    """Pupils of several rules and kinds: a lesson of the teacher's walks, then practice, from `seeds` starts each."""

    bench: BenchmarkRooms
    practice: TrainSettings
    lesson_seconds: float  # of each robot
    seeds: int


@dataclass(frozen=True, kw_only=True)
class ErrataSettings:
    """Robots with an erratum each."""

    bench: BenchmarkRooms


@dataclass(frozen=True, kw_only=True)
class FailureModesSettings:
    """Robots before white walls and in corners."""

    bench: BenchmarkRooms


@dataclass(frozen=True, kw_only=True)
class SensitivitySettings:
    """The robot with one thing changed at a time, and pupils of less data, from `seeds` starts each."""

    bench: BenchmarkRooms
    epochs: int  # of a fit to all data; see `studies.sensitivity.fair` for less
    seeds: int


@dataclass(frozen=True, kw_only=True)
class GaitGradientSettings:
    """The gait fitted through the body: by each method as many simulated seconds, from `seeds` starts."""

    robot_seconds: float
    window: float  # s, through which a derivative goes
    learning_rate: float  # of weights as shares of their size; falls to nothing like half a cosine
    clip: float  # largest norm of a slope
    pairs: int  # of tries from which the evolution strategy estimates a slope
    sigma: float  # by how much it tries, as a share of each weight's size
    evolution_rate: float  # its learning rate
    seeds: int


@dataclass(frozen=True, kw_only=True)
class GradientHorizonSettings:
    """The derivative of a walk against the frames that it goes through, for so many robots."""

    eyes: CameraSettings
    robots: int


@dataclass(frozen=True, kw_only=True)
class FinetuneSettings:
    """The navigator tuned in the closed loop, and practised by DAgger for as long, from `seeds` starts."""

    bench: BenchmarkRooms
    practice: TrainSettings  # rounds of DAgger, each as long as one room of a tune
    lesson_seconds: float  # of each robot
    window: int  # frames through which a derivative goes
    horizons: tuple[int, ...]  # other windows, from the first start; all should go into round_seconds evenly
    learning_rate: float  # a second of window, as a share of the weights' sizes
    clip: float  # largest norm of one robot's gradient, as a multiple of the middle one
    seeds: int
