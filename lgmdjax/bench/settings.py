"""Settings of the comparison in the closed loop, and of the fits, at each scale. Imports no JAX."""

from collections.abc import Mapping
from dataclasses import dataclass

from lgmdjax.evaluation.settings import STIMULUS_SCALES, BenchScale, StimulusBench, TrialName
from lgmdjax.learning.settings import DaggerSettings, DetectorFitSettings
from lgmdjax.sensors.settings import Resolution
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.transfer.names import FaultName

CAMERA_FAULTS: Mapping[str, tuple[FaultName, ...]] = {
    "noise": ("noise",),
    "all faults": ("noise", "exposure", "blur", "jpeg", "drops", "latency"),
}
"""Names of `lgmdjax.transfer.faults` by that of the world in which cameras have them."""


@dataclass(frozen=True, kw_only=True)
class Walks:
    """Walks that are recorded: in how many rooms, and for how long."""

    robots: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class ClosedLoopSettings:
    """Every looming detector as the eyes of the same robot."""

    calibration: Walks  # on which the constants of all detectors are chosen
    demonstrations: Walks  # of the teacher, with which the training begins
    dagger: DaggerSettings  # training of the navigator
    benchmark: BenchmarkRooms  # random rooms in which the robots are scored
    faults: Walks  # the same with faults of the cameras
    scenes: Mapping[TrialName, int]  # robots in each scene
    scene_seconds: float  # longest walk in a scene
    seeds: int  # navigators that are trained for each detector


_EYES = Resolution(width=80, height=60, pooling=3)

CLOSED_LOOP_SCALES: Mapping[BenchScale, ClosedLoopSettings] = {
    "smoke": ClosedLoopSettings(
        calibration=Walks(robots=4, seconds=5),
        demonstrations=Walks(robots=4, seconds=5),
        dagger=DaggerSettings(epochs=2, dagger_rounds=1, round_epochs=2, robots=4, round_seconds=5),
        benchmark=BenchmarkRooms(eyes=_EYES, robots=4, seconds=5),
        faults=Walks(robots=4, seconds=5),
        scenes={"indoor": 2, "white": 2},
        scene_seconds=5,
        seeds=1,
    ),
    "quick": ClosedLoopSettings(
        calibration=Walks(robots=16, seconds=15),
        demonstrations=Walks(robots=16, seconds=30),
        dagger=DaggerSettings(epochs=80, dagger_rounds=2, round_epochs=60, robots=16, round_seconds=30),
        benchmark=BenchmarkRooms(eyes=_EYES, robots=16, seconds=60),
        faults=Walks(robots=16, seconds=30),
        scenes={"indoor": 3, "outdoor": 3, "dynamic": 3, "gap": 4, "white": 3},
        scene_seconds=90,
        seeds=1,
    ),
    "full": ClosedLoopSettings(
        calibration=Walks(robots=16, seconds=20),
        demonstrations=Walks(robots=16, seconds=45),
        dagger=DaggerSettings(epochs=100, dagger_rounds=2, round_epochs=60, robots=16, round_seconds=45),
        benchmark=BenchmarkRooms(eyes=_EYES, robots=32, seconds=60),
        faults=Walks(robots=16, seconds=45),
        scenes={"indoor": 3, "outdoor": 3, "dynamic": 3, "gap": 4, "white": 3},
        scene_seconds=90,
        seeds=3,
    ),
}
"""smoke goes through every step, quick compares one navigator of each detector, full three."""


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Constants of every looming detector fitted by gradient, on recorded walks and on laboratory stimuli."""

    eyes: Resolution  # of the robot that walks
    walks: Walks
    windows: int  # stretches of walks in each step
    stimuli: StimulusBench
    fit: DetectorFitSettings
    seeds: int  # splits of the walks


FIT_SCALES: Mapping[BenchScale, FitSettings] = {
    "smoke": FitSettings(
        eyes=_EYES,
        walks=Walks(robots=4, seconds=10),
        windows=2,
        stimuli=STIMULUS_SCALES["smoke"],
        fit=DetectorFitSettings(steps=2, eval_every=1, learning_rate=0.05),
        seeds=1,
    ),
    "quick": FitSettings(
        eyes=_EYES,
        walks=Walks(robots=16, seconds=20),
        windows=8,
        stimuli=STIMULUS_SCALES["quick"],
        fit=DetectorFitSettings(steps=30, eval_every=6, learning_rate=0.08),
        seeds=1,
    ),
    "full": FitSettings(
        eyes=_EYES,
        walks=Walks(robots=32, seconds=20),
        windows=8,
        stimuli=STIMULUS_SCALES["quick"],
        fit=DetectorFitSettings(steps=60, eval_every=10, learning_rate=0.05),
        seeds=3,
    ),
}
"""smoke goes through every step, quick fits on one split of the walks, full on three."""
