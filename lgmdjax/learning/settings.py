"""Settings of the stage `train` and of the study `lgmd_gradient`. Imports no JAX."""

from dataclasses import dataclass

from lgmdjax.sensors.settings import Resolution


@dataclass(frozen=True, kw_only=True)
class DaggerSettings:
    """Rounds of DAgger, and the fit after the last one."""

    epochs: int  # number of epochs of the final fits
    dagger_rounds: int  # number of rounds of DAgger
    round_epochs: int  # number of epochs of the fit in each round
    robots: int  # number of robots in each round
    round_seconds: float  # simulated time of each robot in a round [s]


@dataclass(frozen=True, kw_only=True)
class TrainSettings(DaggerSettings):
    """Training of the navigator and its variants: rounds of DAgger, then a final fit of every variant."""

    eyes: Resolution  # of the robot's eyes; their field of view is that of the recorded walks
    split_half_epochs: int = 80  # number of epochs of the fit to the teacher's walks split in halves, as in the paper
    variants: tuple[str, ...] = ("lstm", "lstm-efference", "feed-forward", "mean")  # networks to fit and compare
    turn_gains: tuple[float, ...] = ()  # turn gains to compare by walking; none: behaviour_cloning.TURN_GAIN
    turn_gain_seconds: float = 120.0  # simulated time of each robot with each gain [s]


@dataclass(frozen=True, kw_only=True)
class LgmdGradientSettings:
    """Fit of the LGMD to recorded walks by gradient, with and without its navigator."""

    minutes: float  # total duration of the recorded walks to fit to and evaluate on [min]
    seconds: float  # duration of each walk [s]; shorter walks mean more rooms
    epochs: int  # number of epochs of the navigator's own fit, before the LGMD's
    steps: int  # number of optimiser steps
    eval_every: int  # number of steps between two evaluations on held-out walks
    window: int  # number of frames of back-propagation through time
    streams: int  # number of parallel sequences
    learning_rate: float  # initial learning rate of the detector's constants; decays to zero along half a cosine
    navigator_learning_rate: float  # initial learning rate of the navigator's weights; decays likewise
    seeds: int  # number of repeats, each with its own seed


@dataclass(frozen=True, kw_only=True)
class DetectorFitSettings:
    """Fit of any looming detector's constants by gradient."""

    steps: int  # number of optimiser steps
    eval_every: int  # number of steps between two evaluations
    learning_rate: float  # initial learning rate of the logarithms of the constants; decays along half a cosine
