"""Settings of stage train."""

from dataclasses import dataclass

from lgmdjax.sensors.settings import CameraSettings


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """The navigator and those it is compared with, after some rounds of walking itself and being corrected."""

    eyes: CameraSettings
    epochs: int
    rounds: int
    round_epochs: int
    robots: int
    round_seconds: float  # of each robot
    halves_epochs: int = 80  # of the fit to the teacher's walks in halves, the paper's
    variants: tuple[str, ...] = ("lstm", "lstm-efference", "feed-forward", "mean")
    cautions: tuple[float, ...] = ()  # to choose from by walking as in a round; none: `training.CAUTION`


@dataclass(frozen=True, kw_only=True)
class LgmdGradientSettings:
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
