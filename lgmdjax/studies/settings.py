"""Settings of the studies. Imports no JAX, so that the command line needs none."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from lgmdjax.evaluation.settings import TrialName
from lgmdjax.learning.settings import DaggerSettings
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.transfer.names import FAULT_NAMES, FaultName


@dataclass(frozen=True, kw_only=True)
class VelocitySettings:
    """LGMD response against walking velocity; every robot covers the same distance at each velocity."""

    eyes: Resolution  # of the stereo camera
    robots: int  # number of robots, each in a room of its own
    distance: float  # distance that each robot walks at each velocity [m]
    velocities: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0)
    """commanded velocities, as multiples of the nominal 0.05 m/s"""


@dataclass(frozen=True, kw_only=True)
class SupervisionSettings:
    """Navigators trained by several teaching rules, and networks of several kinds."""

    benchmark: BenchmarkRooms  # rooms in which robots are compared
    dagger: DaggerSettings  # DAgger rounds of each learner
    demonstration_seconds: float  # duration of each robot's demonstration [s]
    seeds: int  # number of random seeds for each case


@dataclass(frozen=True, kw_only=True)
class ErrataSettings:
    """Robots with one printed equation each."""

    benchmark: BenchmarkRooms  # rooms in which robots are compared


@dataclass(frozen=True, kw_only=True)
class FailureModesSettings:
    """Robots that walk toward a white wall or into a corner."""

    benchmark: BenchmarkRooms  # rooms in which robots are compared


@dataclass(frozen=True, kw_only=True)
class SensitivitySettings:
    """One parameter changed at a time, and learners trained on less data."""

    benchmark: BenchmarkRooms  # rooms in which robots are compared
    epochs: int  # epochs of a fit to all data; fits to less data take more, see `sensitivity.matched_epochs`
    seeds: int  # number of random seeds for each amount of data


@dataclass(frozen=True, kw_only=True)
class OverlapSettings:
    """Width of each detector's field of view, on recorded walks and in front of a tube."""

    robots: int  # robots of each recorded episode that are rendered again
    seeds: int  # random seeds of the walks toward the tube, 30 walks each
    overlaps: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 1.0)  # fractions of the picture's width


@dataclass(frozen=True, kw_only=True)
class GaitGradientSettings:
    """Gait fitted through the physics, by gradient and by an evolution strategy, for the same simulated time."""

    robot_seconds: float  # simulated time of each fit, all robots together [s]
    window: float  # duration of the window that is differentiated [s]
    learning_rate: float  # of the gradient method, in units of the parameters' RMS; decays by a half cosine to zero
    clip: float  # largest norm of a gradient
    pairs: int  # antithetic pairs in each gradient estimate of the evolution strategy
    sigma: float  # perturbation of the evolution strategy, in units of the parameters' RMS
    evolution_learning_rate: float  # learning rate of the evolution strategy, in the same units
    seeds: int  # number of random seeds for each method


@dataclass(frozen=True, kw_only=True)
class GradientHorizonSettings:
    """Gradient of a closed-loop walk against the number of frames that it is taken through."""

    eyes: Resolution  # of the stereo camera
    robots: int  # number of robots, each in a room of its own


@dataclass(frozen=True, kw_only=True)
class FinetuneSettings:
    """The navigator finetuned in the closed loop, against DAgger for the same simulated time."""

    benchmark: BenchmarkRooms  # rooms in which robots are compared
    dagger: DaggerSettings  # DAgger rounds, each as long as one room of finetuning
    demonstration_seconds: float  # duration of each robot's demonstration [s]
    window: int  # frames through which the gradient is taken
    horizons: tuple[int, ...]  # other windows [frames], tried with the first seed; each should divide a round evenly
    learning_rate: float  # per second of window, in units of the parameters' size
    clip: float  # largest norm of one robot's gradient, as a multiple of the robots' median
    seeds: int  # number of random seeds


@dataclass(frozen=True, kw_only=True)
class TransferSize:
    """Number and duration of the walks of each row of study transfer."""

    robots: int  # in as many random rooms
    seconds: float  # in each room
    seeds: int  # of each scene
    scene_seconds: float


TRANSFER_SIZES: Mapping[str, TransferSize] = {
    "smoke": TransferSize(robots=2, seconds=2.0, seeds=2, scene_seconds=2.0),
    "quick": TransferSize(robots=4, seconds=30.0, seeds=4, scene_seconds=60.0),
    "full": TransferSize(robots=64, seconds=180.0, seeds=12, scene_seconds=90.0),
}
"""One frame of one robot takes 20 ms of one core: a row in random rooms takes a minute at quick, two hours at full."""


@dataclass(frozen=True, kw_only=True)
class TransferSettings:
    """The trained robot in another engine, with faults of cameras, servos and body."""

    scale: Literal["smoke", "quick", "full"] = "quick"
    """how many robots walk for how long: minutes a row, or hours"""
    scenes: tuple[TrialName, ...] = ("indoor", "outdoor")
    """scenes in which learned, teacher and blind walk, in addition to the random rooms"""
    faults: tuple[FaultName, ...] = FAULT_NAMES
    """faults, one at a time and together"""

    def size(self) -> TransferSize:
        """Return number and duration of the walks."""
        return TRANSFER_SIZES[self.scale]
