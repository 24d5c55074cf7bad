"""How much of everything: the settings of each stage at the three scales.

`smoke` goes through every stage in minutes and proves nothing about the robot; `quick` is the smallest that
shows the result; `paper` uses the paper's figures (15 minutes of the teacher, 1000 epochs of its halves, 235.3 m) and
more walks, and adds the studies of `lgmdjax.studies`: a stage that a scale has no settings for is left out. A setting
stands here when the scale or an experiment changes it; physical numbers belong to the components' `Params`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Scale = Literal["smoke", "quick", "paper"]


@dataclass(frozen=True, kw_only=True)
class FitGait:
    """The shaping networks, taught the regular tripod gait, and walked at set velocities."""

    steps: int
    seconds: float  # of each measured walk


@dataclass(frozen=True, kw_only=True)
class Eyes:
    """Pictures of width x height pixels an eye, of which each LGMD gets the part `overlap` on its side.

    Its cells look at `pooling` pixels a side: about 6 degrees at every scale. The two share no column of the picture:
    what both eyes see, which is what stands straight ahead, far off, tells neither side from the other
    (`experiments/overlap.py`).
    """

    width: int
    height: int
    overlap: float = 0.5
    pooling: int = 1


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Walks of the teacher: as many robots at once, each in a room of its own, and new rooms for every episode."""

    eyes: Eyes
    robots: int
    episodes: int
    seconds: float  # of each robot in an episode
    calibration_seconds: float  # of each robot, walked before to choose the thresholds on


@dataclass(frozen=True, kw_only=True)
class Train:
    """The navigator and those it is compared with, after some rounds of walking itself and being corrected."""

    eyes: Eyes
    epochs: int
    rounds: int
    round_epochs: int
    robots: int
    round_seconds: float  # of each robot
    halves_epochs: int = 80  # of the fit to the teacher's walks in halves, the paper's
    variants: tuple[str, ...] = ("lstm", "lstm-efference", "feed-forward", "mean")
    cautions: tuple[float, ...] = ()  # to choose from by walking as in a round; none: `training.CAUTION`


@dataclass(frozen=True, kw_only=True)
class Place:
    """A trial (`lgmdjax.trials`) that some drivers walk: how often, and for how long if not as long as it has time."""

    trial: str
    eyes: Eyes
    seeds: int
    coarse: Eyes | None = None  # of all drivers but the learned one, if it is drawn finer than they
    seconds: float | None = None
    drivers: tuple[str, ...] = ("teacher", "learned", "blind", "direct", "random")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """The drivers in the paper's experiments, and in rooms that nobody has seen."""

    places: tuple[Place, ...]


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The rooms in which a study compares robots: as many, for as long."""

    eyes: Eyes
    robots: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Velocity:
    """The eyes of a robot that walks straight on, at multiples of the nominal velocity, as far at each."""

    eyes: Eyes
    robots: int
    metres: float  # of each robot, at each velocity
    velocities: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0)


@dataclass(frozen=True, kw_only=True)
class Teaching:
    """Pupils of several rules and kinds: a lesson of the teacher's walks, then practice, from `seeds` starts each."""

    bench: Bench
    practice: Train
    lesson_seconds: float  # of each robot
    seeds: int


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Robots with an erratum each."""

    bench: Bench


@dataclass(frozen=True, kw_only=True)
class Failures:
    """Robots before white walls and in corners."""

    bench: Bench


@dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """The robot with one thing changed at a time, and pupils of less data, from `seeds` starts each."""

    bench: Bench
    epochs: int  # of a fit to all data; see `studies.sensitivity.fair` for less
    seeds: int


@dataclass(frozen=True, kw_only=True)
class Stride:
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
class Horizon:
    """The derivative of a walk against the frames that it goes through, for so many robots."""

    eyes: Eyes
    robots: int


@dataclass(frozen=True, kw_only=True)
class Detector:
    """The LGMD fitted on recorded walks, with its navigator and without, from `seeds` starts."""

    minutes: float  # of walking, drawn again
    seconds: float  # of each walk: the shorter, the more rooms
    epochs: int  # of the navigator's own fit, before
    steps: int  # of the optimiser
    every: int  # steps from one look at the walks kept back to the next
    window: int  # frames through which the error goes back
    streams: int
    learning_rate: float  # of the detector's constants as shares; falls to nothing like half a cosine
    navigator_rate: float  # of the navigator's weights, likewise
    seeds: int


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """The navigator tuned in the closed loop, and practised by DAgger for as long, from `seeds` starts."""

    bench: Bench
    practice: Train  # rounds of DAgger, each as long as one room of a tune
    lesson_seconds: float  # of each robot
    window: int  # frames through which a derivative goes
    horizons: tuple[int, ...]  # other windows, from the first start; all should go into round_seconds evenly
    learning_rate: float  # a second of window, as a share of the weights' sizes
    clip: float  # largest norm of one robot's gradient, as a multiple of the middle one
    seeds: int


@dataclass(frozen=True, kw_only=True)
class Report:
    """The page; the video shows one walk."""

    video_seconds: float


_SMALL = Eyes(width=64, height=48, pooling=2)
_QUICK = Eyes(width=80, height=60, pooling=3)
_SMALLER = Eyes(width=160, height=120, pooling=6)
_PAPER = Eyes(width=320, height=240, pooling=12)

SCALES: Mapping[Scale, Mapping[str, Any]] = {
    "smoke": {
        "fit-gait": FitGait(steps=300, seconds=6),
        "collect": Collect(eyes=_SMALL, robots=4, episodes=2, seconds=10, calibration_seconds=5),
        "train": Train(
            eyes=_SMALL,
            epochs=5,
            rounds=1,
            round_epochs=5,
            robots=4,
            round_seconds=10,
            halves_epochs=5,
            variants=("lstm", "feed-forward", "mean"),
        ),
        "evaluate": Evaluate(
            places=(
                Place(trial="testing", eyes=_SMALL, seeds=4, seconds=5),
                Place(trial="unseen", eyes=_SMALL, seeds=4, seconds=5),
            )
        ),
        "report": Report(video_seconds=1),
    },
    "quick": {
        "fit-gait": FitGait(steps=3000, seconds=20),
        "collect": Collect(eyes=_QUICK, robots=16, episodes=2, seconds=45, calibration_seconds=20),
        "train": Train(
            eyes=_QUICK, epochs=80, rounds=3, round_epochs=60, robots=16, round_seconds=60, halves_epochs=80
        ),
        "evaluate": Evaluate(
            places=(
                Place(trial="testing", eyes=_QUICK, seeds=16, seconds=20),
                Place(trial="unseen", eyes=_QUICK, seeds=16, seconds=70),
            )
        ),
        "report": Report(video_seconds=10),
    },
    "paper": {
        "fit-gait": FitGait(steps=6000, seconds=20),
        "collect": Collect(eyes=_PAPER, robots=16, episodes=2, seconds=28.125, calibration_seconds=30),
        "train": Train(
            eyes=_QUICK,
            epochs=100,
            rounds=8,
            round_epochs=60,
            robots=32,
            round_seconds=120,
            halves_epochs=1000,
            cautions=(1.5, 2.0, 2.5, 3.0),
        ),
        "evaluate": Evaluate(
            places=(
                Place(trial="testing", eyes=_PAPER, coarse=_QUICK, seeds=5),
                Place(trial="unseen", eyes=_QUICK, seeds=64),
                Place(trial="tube", eyes=_PAPER, coarse=_QUICK, seeds=8),
                Place(trial="indoor", eyes=_PAPER, coarse=_QUICK, seeds=12),
                Place(trial="outdoor", eyes=_PAPER, coarse=_QUICK, seeds=10),
                Place(trial="dynamic", eyes=_PAPER, coarse=_QUICK, seeds=10),
                Place(trial="white", eyes=_QUICK, seeds=12),
                Place(trial="corner", eyes=_QUICK, seeds=12),
            )
        ),
        "velocity": Velocity(eyes=_SMALLER, robots=16, metres=1.2),
        "teaching": Teaching(
            bench=Bench(eyes=_QUICK, robots=16, seconds=90),
            practice=Train(eyes=_QUICK, epochs=80, rounds=2, round_epochs=60, robots=16, round_seconds=60),
            lesson_seconds=30,
            seeds=3,
        ),
        "printed": Printed(bench=Bench(eyes=_QUICK, robots=16, seconds=60)),
        "failures": Failures(bench=Bench(eyes=_QUICK, robots=16, seconds=90)),
        "sensitivity": Sensitivity(bench=Bench(eyes=_QUICK, robots=16, seconds=60), epochs=30, seeds=2),
        "report": Report(video_seconds=30),
    },
}

GRADIENTS: Mapping[str, Any] = {
    "horizon": Horizon(eyes=_SMALL, robots=6),
    # Of 1, 2 and 8 pairs, sigma 0.0003 to 0.02 and rates of 1.25e-3 to 1.5e-2 these serve the evolution strategy best.
    "stride": Stride(
        robot_seconds=9000.0,
        window=1.6,
        learning_rate=5e-3,
        clip=1.0,
        pairs=1,
        sigma=1e-3,
        evolution_rate=2.5e-3,
        seeds=3,
    ),
    "detector": Detector(
        minutes=60.0,
        seconds=28.0,
        epochs=60,
        steps=400,
        every=25,
        window=60,
        streams=32,
        learning_rate=1e-2,
        navigator_rate=1e-3,
        seeds=3,
    ),
    "closed_loop": ClosedLoop(
        bench=Bench(eyes=_QUICK, robots=16, seconds=90),
        practice=Train(eyes=_QUICK, epochs=80, rounds=2, round_epochs=60, robots=16, round_seconds=30),
        lesson_seconds=30,
        window=15,
        horizons=(5, 45),
        learning_rate=1e-2,
        clip=10.0,
        seeds=3,
    ),
}
"""Settings of the studies of gradients through the walk; they are no stages of a run."""
