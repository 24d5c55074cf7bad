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
    """The shaping networks, taught the regular tripod gait."""

    steps: int


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Walks of the teacher, each robot in a room of its own; pictures of width x height pixels an eye."""

    robots: int
    seconds: float  # of each robot
    width: int
    height: int


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
        "fit-gait": FitGait(steps=200),
        "collect": Collect(robots=2, seconds=10, width=80, height=60),
        "train": Train(epochs=5),
        "evaluate": Evaluate(rooms=2, seconds=5, metres=0.5),
        "report": Report(video_seconds=2),
    },
    "quick": {
        "fit-gait": FitGait(steps=2000),
        "collect": Collect(robots=16, seconds=120, width=160, height=120),
        "train": Train(epochs=200),
        "evaluate": Evaluate(rooms=16, seconds=60, metres=20),
        "report": Report(video_seconds=15),
    },
    "paper": {
        "fit-gait": FitGait(steps=5000),
        "collect": Collect(robots=16, seconds=900, width=320, height=240),
        "train": Train(epochs=1000),
        "evaluate": Evaluate(rooms=64, seconds=180, metres=235.3),
        "report": Report(video_seconds=60),
    },
}
