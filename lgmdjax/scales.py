"""How much of everything: the settings of each stage at the three scales.

`smoke` goes through every stage in minutes and proves nothing about the robot; `quick` is the smallest that
shows the result; `paper` uses the paper's figures (15 minutes of data, 1000 epochs, 235.3 m). A setting
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

    Its cells look at `pooling` pixels a side: about 6 degrees at every scale.
    """

    width: int
    height: int
    overlap: float = 0.6
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


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Every driver on the same seeds: as many robots in the testing room, and in unseen rooms of their own."""

    eyes: Eyes
    robots: int
    seconds: float  # of each robot, in the unseen rooms
    testing_seconds: float  # of each robot, in the testing room


@dataclass(frozen=True, kw_only=True)
class Report:
    """The page; the video shows one walk."""

    video_seconds: float


_SMALL = Eyes(width=64, height=48, pooling=2)
_QUICK = Eyes(width=80, height=60, pooling=3)
_PAPER = Eyes(width=320, height=240, pooling=12)

SCALES: Mapping[Scale, Mapping[str, Any]] = {
    "smoke": {
        "fit-gait": FitGait(steps=300, seconds=6),
        "collect": Collect(eyes=_SMALL, robots=4, episodes=2, seconds=10, calibration_seconds=5),
        "train": Train(eyes=_SMALL, epochs=5, rounds=1, round_epochs=5, robots=4, round_seconds=10),
        "evaluate": Evaluate(eyes=_SMALL, robots=4, seconds=5, testing_seconds=5),
        "report": Report(video_seconds=1),
    },
    "quick": {
        "fit-gait": FitGait(steps=3000, seconds=20),
        "collect": Collect(eyes=_QUICK, robots=16, episodes=2, seconds=45, calibration_seconds=20),
        "train": Train(eyes=_QUICK, epochs=80, rounds=3, round_epochs=60, robots=16, round_seconds=60),
        "evaluate": Evaluate(eyes=_QUICK, robots=16, seconds=70, testing_seconds=20),
        "report": Report(video_seconds=10),
    },
    "paper": {
        "fit-gait": FitGait(steps=6000, seconds=20),
        "collect": Collect(eyes=_PAPER, robots=16, episodes=2, seconds=28.125, calibration_seconds=30),
        "train": Train(eyes=_PAPER, epochs=1000, rounds=2, round_epochs=200, robots=16, round_seconds=60),
        "evaluate": Evaluate(eyes=_PAPER, robots=16, seconds=180, testing_seconds=270),
        "report": Report(video_seconds=30),
    },
}
