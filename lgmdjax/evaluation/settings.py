"""Names of the trials and settings of one trial in stage evaluate; free of JAX, for a fast command line."""

from dataclasses import dataclass
from typing import Literal

from lgmdjax.control.names import POLICY_NAMES, PolicyName
from lgmdjax.sensors.settings import CameraSettings

TrialName = Literal[
    "testing", "unseen", "tube", "indoor", "outdoor", "dynamic", "gap", "gap-70cm", "gap-60cm", "white", "corner"
]
"""The trials of `lgmdjax.evaluation.trials`, in the order of its `TRIALS`."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """One trial of stage evaluate: with which policies, how often, and for how long."""

    trial: TrialName  # name of the trial
    eyes: CameraSettings  # camera settings of the learned policy
    seeds: int  # number of repetitions, each with its own textures and start poses
    coarse: CameraSettings | None = None  # camera settings of all other policies; the same as `eyes` if None
    seconds: float | None = None  # duration of each walk [s]; as long as the trial says if None
    policies: tuple[PolicyName, ...] = POLICY_NAMES  # names of the policies
