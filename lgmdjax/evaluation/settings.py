"""Names of the trials, and settings of one trial in stage evaluate. Imports no JAX, for a fast command line."""

from dataclasses import dataclass
from typing import Literal

from lgmdjax.control.names import POLICY_NAMES, PolicyName
from lgmdjax.sensors.settings import Resolution

TrialName = Literal[
    "testing", "unseen", "tube", "indoor", "outdoor", "dynamic", "gap", "gap-70cm", "gap-60cm", "traverse", "pocket",
    "white", "corner",
]  # fmt: skip
"""The trials of `lgmdjax.evaluation.trials`, in the order of its `TRIALS`."""


BenchScale = Literal["smoke", "quick", "full"]
"""Scales of `lgmdjax bench`."""


@dataclass(frozen=True, kw_only=True)
class StimulusBench:
    """Laboratory stimuli on which looming detectors are compared."""

    width: int  # of the frames [px]
    height: int  # [px]
    l_over_v: tuple[float, ...]  # of the approaches whose peaks are timed [s]
    frame_rate: int = 30  # frames a second


STIMULUS_SCALES: dict[str, StimulusBench] = {
    "smoke": StimulusBench(width=32, height=24, l_over_v=(0.03, 0.06, 0.12)),
    "quick": StimulusBench(width=80, height=60, l_over_v=(0.01, 0.02, 0.05, 0.1, 0.2, 0.4)),
    "full": StimulusBench(width=160, height=120, l_over_v=(0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)),
}
"""smoke runs in seconds, quick in a minute, full has l/|v| from 10 ms to 2 s."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """One trial of stage evaluate: with which policies, how often, and for how long."""

    trial: TrialName  # name of the trial
    eyes: Resolution  # image size of the learned policy's eyes
    seeds: int  # number of repetitions, each with its own textures and start poses
    coarse: Resolution | None = None  # image size of all other policies' eyes; the same as `eyes` if None
    seconds: float | None = None  # duration of each walk [s]; that of the trial if None
    policies: tuple[PolicyName, ...] = POLICY_NAMES  # policies to run
