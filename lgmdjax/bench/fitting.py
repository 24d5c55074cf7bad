"""Constants of every looming detector, before and after a fit by gradient on the same data.

| stage           | what it does                                                                                    |
| --------------- | ----------------------------------------------------------------------------------------------- |
| walks           | records walks of the teacher, without pictures                                                  |
| detector-<name> | scores the published constants, those of a search over cells and contrast, and those of the fit |
| scores          | scores.json, a row for each detector                                                            |

There are two kinds of data (`lgmdjax.learning.detector_objectives`). On recorded walks the score is the correlation r
of u_left - u_right with the difference of proximity; half of the rooms serve search and fit, a quarter the choice of
the step, and the last quarter is scored. Each seed has another split. On laboratory stimuli the score is the area under
ROC of approach against the rest, of stimuli with other sizes and speeds than those that search and fit get.

The search is that of `lgmdjax.learning.detector_calibration` on walks; on stimuli it is over the contrast alone. The
fit (`lgmdjax.learning.detector_fit`) starts where the search ended.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from lgmdjax.bench import stages, teacher_walks
from lgmdjax.bench.settings import FitSettings
from lgmdjax.bench.stages import SCORES, WALKS, StageSettings
from lgmdjax.detectors import scaled
from lgmdjax.evaluation import metrics, stimulus_clips, stimulus_scores
from lgmdjax.evaluation.stimulus_scores import DetectorSetup
from lgmdjax.learning import detector_calibration, detector_fit
from lgmdjax.learning.detector_objectives import Stimuli, Walks
from lgmdjax.runtime import storage
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, closed_loop

STEPS = ("published", "searched", "fitted")
CONTRASTS = tuple(2.0**power for power in range(-6, 7))  # of the search on stimuli


def plan(
    robot: closed_loop.Params, names: Sequence[str], size: FitSettings
) -> tuple[list[Stage], dict[str, StageSettings[FitSettings]]]:
    """Return the stages of the fits, in order, and their settings by name."""
    robot = assembly.with_resolution(robot, size.eyes)
    made, settings = stages.plan(robot, names, size, record_walks, fit_detector)
    made.append(Stage(name=SCORES, run=gather, inputs=tuple(stage.name for stage in made[1:])))
    return made, settings | {SCORES: settings[WALKS]}


def record_walks(
    robot: closed_loop.Params, folder: Path, _: Mapping[str, Path], settings: StageSettings[FitSettings], seed: int
) -> None:
    """Record walks of the teacher that turns away from everything near."""
    teacher_walks.record_turning(folder, robot, settings.size.walks, seed)


def fit_detector(
    robot: closed_loop.Params, folder: Path, inputs: Mapping[str, Path], settings: StageSettings[FitSettings], seed: int
) -> None:
    """Write scores.json of one detector: scores and constants at each of `STEPS`, and the curves of the fits."""
    size, name = settings.size, settings.detector
    setup = stimulus_scores.get_detector(name)
    walks = read_walks(robot, inputs[WALKS], size, seed)
    runs = [fit_on_walks(robot, setup, walks, size, seed + repeat, name) for repeat in range(size.seeds)]
    scores = {step: asdict(metrics.student_mean([run["scores"][step] for run in runs])) for step in STEPS}
    row = {
        "detector": name,
        "walks": {"scores": scores, "runs": runs},
        "stimuli": fit_on_stimuli(setup, size, seed, name),
    }
    storage.write_json(folder / "scores.json", row)


def read_walks(robot: closed_loop.Params, folder: Path, size: FitSettings, seed: int) -> Walks:
    """Return the recorded walks, and their pictures."""
    record, pictures = teacher_walks.read_turning(folder, robot, size.walks, seed)
    return Walks(robot=robot.controller, record=record, pictures=pictures)


def split(robots: int, seed: int) -> list[np.ndarray]:
    """Return which robots serve the fit (a half), the choice of the step, and the score (a quarter each).

    >>> [len(part) for part in split(16, 0)]
    [8, 4, 4]
    """
    order = np.random.default_rng(seed).permutation(robots)
    return np.split(order, [robots // 2, 3 * robots // 4])


def fit_on_walks(
    robot: closed_loop.Params, setup: DetectorSetup, walks: Walks, size: FitSettings, seed: int, name: str
) -> JsonObject:
    """Return r on held-out walks at each of `STEPS`, the constants before and after the fit, and its curve."""
    fitting, choosing, held_out = (walks.of(some) for some in split(len(walks.pictures), seed))
    published = scaled.Params(model=setup.detector, detector=setup.hemifield())
    calibrated, _ = detector_calibration.calibrate(
        robot, setup.detector, setup.hemifield(), fitting.record, fitting.pictures
    )
    searched: scaled.Params = calibrated.controller.detector
    fitted, curve = detector_fit.fit(
        searched,
        fitting.loss,
        partial(fitting.sample, size.windows),
        choosing.score,
        size.fit,
        seed=seed,
        label=f"{name}, walks {seed}",
    )
    scores = [held_out.score(params) for params in (published, searched, fitted)]
    return _summarise(scores, searched, fitted, curve) | {"cells": searched.pooling}


def fit_on_stimuli(setup: DetectorSetup, size: FitSettings, seed: int, name: str) -> JsonObject:
    """Return the area under ROC of other stimuli at each of `STEPS`, the constants, and the fit's curve."""
    own, other = (render_stimuli(size, motions) for motions in (stimulus_clips.SCORED, stimulus_clips.OTHER))
    eye = camera.Params(width=size.stimuli.width, height=size.stimuli.height)
    published = scaled.Params(model=setup.detector, detector=setup.params(eye))
    candidates = [replace(published, contrast=jnp.asarray(contrast, float)) for contrast in CONTRASTS]
    searched = max([published, *candidates], key=own.score)
    fitted, curve = detector_fit.fit(
        searched, own.loss, own.sample, own.score, size.fit, seed=seed, label=f"{name}, stimuli"
    )
    scores = [other.score(params) for params in (published, searched, fitted)]
    return _summarise(scores, searched, fitted, curve)


def render_stimuli(size: FitSettings, motions: stimulus_clips.Motions) -> Stimuli:
    """Return a clip of every stimulus."""
    clips = stimulus_clips.selection(size.stimuli, motions)
    return Stimuli(frames=clips.frames, approaches=np.array([name.startswith("approach") for name in clips.names]))


def _summarise(
    scores: Sequence[float], searched: scaled.Params, fitted: scaled.Params, curve: list[JsonObject]
) -> JsonObject:
    before, after = detector_fit.constants(searched), detector_fit.constants(fitted)
    constants = {name: {"before": before[name].tolist(), "after": after[name].tolist()} for name in before}
    return {"scores": dict(zip(STEPS, scores, strict=True)), "constants": constants, "curve": curve}


def gather(folder: Path, inputs: Mapping[str, Path], settings: StageSettings[FitSettings], seed: int) -> None:
    """Write scores.json: the rows of all detectors."""
    storage.write_json(folder / "scores.json", [storage.read_json(place / "scores.json") for place in inputs.values()])
