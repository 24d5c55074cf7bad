"""Presets of the settings: those of each stage at the three scales, and those of the other studies.

| scale | stages                                                                                                     |
| ----- | ---------------------------------------------------------------------------------------------------------- |
| smoke | goes through every stage in minutes; its results mean nothing                                              |
| quick | the smallest that shows the result                                                                         |
| paper | the paper's sizes (15 minutes of the teacher, 1000 epochs on halves of its walks, 235.3 m) and more walks; |
|       | also five studies of `lgmdjax.studies`                                                                     |

A stage without settings in a scale is left out. A setting is here if the scale or a study changes it; physical
constants belong to the components' `Params`. Imports no JAX, so that the command line needs none.
"""

from collections.abc import Mapping
from typing import Literal

from lgmdjax.evaluation.settings import TrialPlan
from lgmdjax.learning.settings import DaggerSettings, LgmdGradientSettings, TrainSettings
from lgmdjax.pipeline.settings import CollectSettings, EvaluateSettings, FitGaitSettings, ReportSettings
from lgmdjax.sensors.settings import CameraSettings, Resolution
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies.settings import (
    ErrataSettings,
    FailureModesSettings,
    FinetuneSettings,
    GaitGradientSettings,
    GradientHorizonSettings,
    OverlapSettings,
    SensitivitySettings,
    SupervisionSettings,
    TransferSettings,
    VelocitySettings,
)

Scale = Literal["smoke", "quick", "paper"]
StageSettings = FitGaitSettings | CollectSettings | TrainSettings | EvaluateSettings | ReportSettings
StudySettings = (
    VelocitySettings
    | SupervisionSettings
    | ErrataSettings
    | FailureModesSettings
    | SensitivitySettings
    | OverlapSettings
    | GaitGradientSettings
    | LgmdGradientSettings
    | GradientHorizonSettings
    | FinetuneSettings
    | TransferSettings
)

_SMALL = Resolution(width=64, height=48, pooling=2)
_QUICK = Resolution(width=80, height=60, pooling=3)
_MEDIUM = Resolution(width=160, height=120, pooling=6)
_PAPER = Resolution(width=320, height=240, pooling=12)


def _with_field(resolution: Resolution) -> CameraSettings:
    """Return a camera whose LGMDs see only above the horizon, with the largest weights straight ahead."""
    return CameraSettings(**vars(resolution), ground=0.5, falloff=2.0)


SCALES: Mapping[Scale, Mapping[str, StageSettings | StudySettings]] = {
    "smoke": {
        "fit-gait": FitGaitSettings(steps=300, seconds=6),
        "collect": CollectSettings(eyes=_with_field(_QUICK), robots=4, episodes=2, seconds=10, calibration_seconds=5),
        "train": TrainSettings(
            eyes=_QUICK,
            epochs=5,
            dagger_rounds=1,
            round_epochs=5,
            robots=4,
            round_seconds=10,
            split_half_epochs=5,
            variants=("lstm", "feed-forward", "mean"),
        ),
        "evaluate": EvaluateSettings(
            trials=(
                TrialPlan(trial="testing", eyes=_QUICK, seeds=4, seconds=5),
                TrialPlan(trial="unseen", eyes=_QUICK, seeds=4, seconds=5),
            )
        ),
        "report": ReportSettings(video_seconds=1),
    },
    "quick": {
        "fit-gait": FitGaitSettings(steps=3000, seconds=20),
        "collect": CollectSettings(eyes=_with_field(_QUICK), robots=16, episodes=2, seconds=45, calibration_seconds=20),
        "train": TrainSettings(
            eyes=_QUICK, epochs=80, dagger_rounds=3, round_epochs=60, robots=16, round_seconds=60, split_half_epochs=80
        ),
        "evaluate": EvaluateSettings(
            trials=(
                TrialPlan(trial="testing", eyes=_QUICK, seeds=16, seconds=60),
                TrialPlan(trial="unseen", eyes=_QUICK, seeds=16, seconds=70),
            )
        ),
        "report": ReportSettings(video_seconds=10),
    },
    "paper": {
        "fit-gait": FitGaitSettings(steps=6000, seconds=20),
        "collect": CollectSettings(
            eyes=_with_field(_PAPER), robots=16, episodes=2, seconds=28.125, calibration_seconds=30
        ),
        "train": TrainSettings(
            eyes=_QUICK,
            epochs=100,
            dagger_rounds=8,
            round_epochs=60,
            robots=32,
            round_seconds=120,
            split_half_epochs=1000,
            turn_gains=(1.0, 1.5, 2.0, 2.5),
        ),
        "evaluate": EvaluateSettings(
            trials=(
                TrialPlan(trial="testing", eyes=_PAPER, coarse=_QUICK, seeds=5),
                TrialPlan(trial="unseen", eyes=_QUICK, seeds=64),
                TrialPlan(trial="tube", eyes=_PAPER, coarse=_QUICK, seeds=8),
                TrialPlan(trial="indoor", eyes=_PAPER, coarse=_QUICK, seeds=12),
                TrialPlan(trial="outdoor", eyes=_PAPER, coarse=_QUICK, seeds=10),
                TrialPlan(trial="dynamic", eyes=_PAPER, coarse=_QUICK, seeds=10),
                TrialPlan(trial="gap", eyes=_QUICK, seeds=40),
                TrialPlan(trial="gap-70cm", eyes=_QUICK, seeds=40),
                TrialPlan(trial="gap-60cm", eyes=_QUICK, seeds=40),
                TrialPlan(trial="traverse", eyes=_QUICK, seeds=40),
                TrialPlan(trial="pocket", eyes=_QUICK, seeds=10),
                TrialPlan(trial="white", eyes=_QUICK, seeds=12),
                TrialPlan(trial="corner", eyes=_QUICK, seeds=12),
            )
        ),
        "velocity": VelocitySettings(eyes=_MEDIUM, robots=16, distance=1.2),
        "supervision": SupervisionSettings(
            benchmark=BenchmarkRooms(eyes=_QUICK, robots=16, seconds=90),
            dagger=DaggerSettings(epochs=80, dagger_rounds=2, round_epochs=60, robots=16, round_seconds=60),
            demonstration_seconds=30,
            seeds=3,
        ),
        "errata": ErrataSettings(benchmark=BenchmarkRooms(eyes=_QUICK, robots=16, seconds=60)),
        "failure_modes": FailureModesSettings(benchmark=BenchmarkRooms(eyes=_QUICK, robots=16, seconds=90)),
        "sensitivity": SensitivitySettings(
            benchmark=BenchmarkRooms(eyes=_QUICK, robots=16, seconds=60), epochs=30, seeds=2
        ),
        "report": ReportSettings(video_seconds=30),
    },
}

STUDY_PRESETS: Mapping[str, StudySettings] = {
    "overlap": OverlapSettings(robots=8, seeds=4),
    "gradient_horizon": GradientHorizonSettings(eyes=_SMALL, robots=6),
    # The evolution strategy's settings are the best of 1, 2 and 8 pairs, sigma 0.0003 to 0.02, rates 1.25e-3 to 1.5e-2.
    "gait_gradient": GaitGradientSettings(
        robot_seconds=9000.0,
        window=1.6,
        learning_rate=5e-3,
        clip=1.0,
        pairs=1,
        sigma=1e-3,
        evolution_learning_rate=2.5e-3,
        seeds=3,
    ),
    "lgmd_gradient": LgmdGradientSettings(
        minutes=60.0,
        seconds=28.0,
        epochs=60,
        steps=400,
        eval_every=25,
        window=60,
        streams=32,
        learning_rate=1e-2,
        navigator_learning_rate=1e-3,
        seeds=3,
    ),
    "closed_loop_finetune": FinetuneSettings(
        benchmark=BenchmarkRooms(eyes=_QUICK, robots=16, seconds=90),
        dagger=DaggerSettings(epochs=80, dagger_rounds=2, round_epochs=60, robots=16, round_seconds=30),
        demonstration_seconds=30,
        window=15,
        horizons=(5, 45),
        learning_rate=1e-2,
        clip=10.0,
        seeds=3,
    ),
    "transfer": TransferSettings(),
}
"""Settings of the studies that are not stages of a run."""
