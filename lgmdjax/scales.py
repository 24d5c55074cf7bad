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
    """Pictures of width x height pixels an eye, of which each LGMD gets the part `overlap` on its side."""

    width: int
    height: int
    overlap: float = 0.6


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
    """The navigator and those it is compared with."""

    epochs: int


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Every driver on the same seeds: in the testing room, and in as many unseen rooms."""

    rooms: int
    seconds: float
    metres: float  # walked in the testing room


@dataclass(frozen=True, kw_only=True)
class Report:
    """The page; the video shows one walk."""

    video_seconds: float


SCALES: Mapping[Scale, Mapping[str, Any]] = {
    "smoke": {
        "fit-gait": FitGait(steps=200, seconds=6),
        "collect": Collect(robots=2, seconds=10, width=80, height=60),
        "train": Train(epochs=5),
        "evaluate": Evaluate(rooms=2, seconds=5, metres=0.5),
        "report": Report(video_seconds=2),
    },
    "quick": {
        "fit-gait": FitGait(steps=3000, seconds=20),
        "collect": Collect(robots=16, seconds=120, width=160, height=120),
        "train": Train(epochs=200),
        "evaluate": Evaluate(rooms=16, seconds=60, metres=20),
        "report": Report(video_seconds=15),
    },
    "paper": {
        "fit-gait": FitGait(steps=4500, seconds=20),
        "collect": Collect(robots=16, seconds=900, width=320, height=240),
        "train": Train(epochs=1000),
        "evaluate": Evaluate(rooms=64, seconds=180, metres=235.3),
        "report": Report(video_seconds=60),
    },
}
