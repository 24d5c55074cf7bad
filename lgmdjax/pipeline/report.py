"""The report: a run folder in, one self-contained page out that a stranger can read.

Only files of the run folder are read; every number on the page comes from them. Pictures and the film are
written into the page itself, so that it works offline. The page appears whole or not at all.

| section       | made from                                                                   |
| ------------- | --------------------------------------------------------------------------- |
| result, film  | evaluate/evaluation.json, evaluate/walk.npz                                 |
| legs          | fit-gait/gait.json, fit-gait/cpg.npz, fit-gait/foot.npz                     |
| eyes          | evaluate/layers.npz, collect/calibration.json                               |
| learning      | train/training.json, train/prediction.npz                                   |
| walking       | evaluate/evaluation.json, evaluate/kinds.json, evaluate/trajectories.npz    |
| experiments   | evaluate/evaluation.json, evaluate/<trial>.svg                              |
| studies       | <study>/<study>.json, where the scale has studies                           |
| how made      | run.json, the done.json of each stage                                       |
"""

import base64
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from lgmdjax.body import hexapod
from lgmdjax.errors import InputError
from lgmdjax.evaluation import collision_causes, trials
from lgmdjax.locomotion.tripod_gait import Gait
from lgmdjax.paths import PACKAGE
from lgmdjax.pipeline.settings import ReportSettings
from lgmdjax.reporting import walk_video
from lgmdjax.reporting.figures import detection, learning, locomotion, style, trajectories
from lgmdjax.runtime.storage import read_arrays, read_json
from lgmdjax.sensors import camera
from lgmdjax.studies import errata, failure_modes, sensitivity, supervision, velocity
from lgmdjax.world import arena, scenes

MINUS = "\N{MINUS SIGN}"
NOMINAL = float(Gait().nominal_velocity)  # m/s, the speed at v = 1
STAGES = ("fit-gait", "collect", "train", "evaluate")  # the folders of their files, and the commands that make them
STUDIES = {
    "velocity": velocity,
    "supervision": supervision,
    "errata": errata,
    "failure_modes": failure_modes,
    "sensitivity": sensitivity,
}
PLACES = {name: trial.title for name, trial in trials.TRIALS.items()}
LOOKS_AT = {
    "teacher": "laser scanner",
    "learned": "both LGMDs",
    "blind": "nothing",
    "direct": "both LGMDs",
    "random": "nothing",
}
LEARNERS = {
    "lstm": "LSTM",
    "lstm-halves": "LSTM, teacher's walks halved (as in the paper)",
    "lstm-efference": "LSTM, last command too",
    "feed-forward": "feed-forward",
    "mean": "mean command",
}
Numbers = Mapping[str, np.ndarray]


def work(folder: Path, inputs: Mapping[str, Path], settings: ReportSettings, seed: int) -> None:
    """Write index.html from the folders of all stages before."""
    render(folder.parent, folder, video_seconds=settings.video_seconds)


def render(
    run: Path,
    folder: Path | None = None,
    *,
    room: arena.Arena | None = None,
    video_seconds: float = 10.0,
) -> Path:
    """Write the page of a run folder; give its path.

    Args:
        run: the run folder, with every stage before this one done.
        folder: where index.html goes; report/ in the run folder if not given.
        room: the room of the testing walks; the paper's testing room if not given.
        video_seconds: length of the film.

    Raises InputError when a file is missing or cannot be read, and names the stage that makes it.
    """
    room = scenes.testing_room() if room is None else room
    page = _environment().get_template("report.html.j2")
    try:
        text = page.render(**_contents(run, room, video_seconds))
    except (KeyError, jinja2.UndefinedError) as error:
        raise InputError(
            f"expected a run folder of this version of lgmdjax, {run} lacks {error}; delete it and run again"
        ) from error
    folder = run / "report" if folder is None else folder
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "index.html"
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)
    return path


def _contents(run: Path, room: arena.Arena, video_seconds: float) -> dict[str, Any]:
    """Gather everything that the template names."""
    facts = read_json(run / "run.json")
    gait, evaluation = read_json(run / "fit-gait/gait.json"), read_json(run / "evaluate/evaluation.json")
    training, calibration = read_json(run / "train/training.json"), read_json(run / "collect/calibration.json")
    rhythm = read_arrays(run / "fit-gait/cpg.npz")
    studies = _studies(run, facts["settings"])
    studied = studies["studied"]
    stages = [{"name": stage, **read_json(run / f"{stage}/done.json")} for stage in (*STAGES, *studied)]
    walked = {place: table for place, table in evaluation.items() if "per_100_m" in next(iter(table.values()))}
    passed = {trial: table for trial, table in evaluation.items() if trial not in walked}
    kinds, places = read_json(run / "evaluate/kinds.json"), facts["settings"]["evaluate"]["places"]
    shown = next(place["eyes"] for place in places if place["trial"] == "testing")
    eyes = camera.Params(width=shown["width"], height=shown["height"])
    drawn = {
        **_gait_figures(run, gait, rhythm),
        **_eye_figures(run, calibration),
        **_learning_figures(run, training),
        **_walking_figures(run, walked, room),
        **{name: STUDIES[name].draw(rows) for name, rows in studied.items()},
    }
    pictures = {name: style.to_svg(figure) for name, figure in drawn.items()}
    pictures |= {trial: (run / f"evaluate/{trial}.svg").read_bytes() for trial in passed}
    return {
        "figures": {name: _inline("image/svg+xml", picture) for name, picture in pictures.items()},
        "film": _film(run, eyes, calibration, room, video_seconds),
        "eyes": eyes,
        "layers_size": list(reversed(read_arrays(run / "evaluate/layers.npz")["picture"].shape)),
        "rounds": facts["settings"]["train"].get("rounds", 0),
        "facts": facts,
        "gait": gait,
        "rhythm": {name: float(rhythm[name]) for name in ("period", "transient_cycles")},
        "calibration": calibration,
        "training": training,
        "evaluation": walked,
        "verdicts": {place: verdict(scores) for place, scores in walked.items()},
        "passed": passed,
        "kinds": {place: counts for place, counts in kinds.items() if any(counts.values())},
        "meanings": collision_causes.KINDS,
        "coarse": _coarse(facts["settings"]),
        "experiments": trials.TRIALS,
        **studies,
        "stages": stages,
        "versions": versions(stages),
        "size": _size(),
        "places": PLACES,
        "looks_at": LOOKS_AT,
        "learners": LEARNERS,
        "nominal": NOMINAL,
    }


def _studies(run: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Read the studies that the run has, and what is told of them beside their figures."""
    studied = {name: read_json(run / f"{name}/{name}.json") for name in STUDIES if name in settings}
    return {
        "studied": studied,
        "best_velocity": velocity.best(studied["velocity"]) if "velocity" in studied else None,
        "band": velocity.BAND,
        "pupils": supervision.pooled(studied.get("supervision", [])),
    }


def _coarse(settings: Mapping[str, Any]) -> dict[str, str]:
    """Tell where pictures were smaller than the paper's, and how large they were."""
    train, paper = settings["train"].get("eyes"), camera.Params()
    eyes = {"while it learned": train} if train else {}
    eyes |= {f"in {PLACES[place['trial']]}": place["eyes"] for place in settings["evaluate"]["places"]}
    others = [place["coarse"] for place in settings["evaluate"]["places"] if place.get("coarse")]
    eyes |= {"of the other drivers": others[0]} if others else {}
    studies = {name: settings[name] for name in STUDIES if name in settings}
    eyes |= {f"in the study of {name}": study.get("eyes") or study["bench"]["eyes"] for name, study in studies.items()}
    small = {where: (e["width"], e["height"]) for where, e in eyes.items() if e["width"] < paper.width}
    return {where: f"{width} × {height}" for where, (width, height) in small.items()}


def verdict(scores: Mapping[str, Any]) -> dict[str, Any]:
    """Compare the learned controller with walking blindly: ratio of rates, and whether the intervals part."""
    learned, blind = scores["learned"]["per_100_m"], scores["blind"]["per_100_m"]
    return {
        "ratio": learned["value"] / blind["value"] if blind["value"] else math.nan,
        "half": learned["value"] < 0.5 * blind["value"],
        "tenth": learned["value"] < 0.1 * blind["value"],
        "apart": learned["high"] < blind["low"],
    }


def versions(stages: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Name the version of each package that the stages ran with; where they differ, all of them with their stages."""
    found: dict[str, dict[str, list[str]]] = {}
    for stage in stages:
        for package, version in stage["versions"].items():
            found.setdefault(package, {}).setdefault(version, []).append(stage["name"])
    return {
        package: "; ".join(f"{version} ({', '.join(names)})" for version, names in users.items())
        if len(users) > 1
        else next(iter(users))
        for package, users in found.items()
    }


def _gait_figures(run: Path, gait: Mapping[str, Any], rhythm: Numbers) -> dict[str, Figure]:
    foot = read_arrays(run / "fit-gait/foot.npz")
    period, cycles = float(rhythm["period"]), float(rhythm["transient_cycles"])
    return {
        "rhythm": locomotion.rhythm(rhythm["time"], rhythm["rhythm"], period, cycles),
        "foot": locomotion.foot_paths(foot["velocities"], foot["commanded"], foot["simulated"], foot["literal"]),
        "sweep": locomotion.gait_sweep(gait["sweep"], gait["literal"], NOMINAL),
    }


def _eye_figures(run: Path, calibration: Mapping[str, Any]) -> dict[str, Figure]:
    seen = read_arrays(run / "evaluate/layers.npz")
    return {
        "layers": detection.layers(seen["picture"], seen["E"], seen["I"], seen["S"]),
        "calibration": detection.calibration(calibration["table"], calibration),
    }


def _learning_figures(run: Path, training: Mapping[str, Any]) -> dict[str, Figure]:
    seen = read_arrays(run / "train/prediction.npz")
    series = (seen[name] for name in ("time", "u", "distances", "label", "predicted"))
    return {"losses": learning.losses(training["curves"], LEARNERS), "stretch": learning.stretch(*series)}


def _walking_figures(run: Path, evaluation: Mapping[str, Any], room: arena.Arena) -> dict[str, Figure]:
    paths = read_arrays(run / "evaluate/trajectories.npz")
    walks = {
        name: trajectories.Walks(*(paths[f"testing_{name}{part}"] for part in ("", "_setbacks", "_contact")))
        for name in evaluation["testing"]
    }
    places = {PLACES[place]: scores for place, scores in evaluation.items()}
    return {"trajectories": trajectories.trajectories(room, walks), "drivers": trajectories.drivers(places)}


def _film(run: Path, eyes: camera.Params, calibration: Mapping[str, Any], room: arena.Arena, seconds: float) -> str:
    """Draw the film of the learned controller's walk, its eyes as fine as they were; give a data address."""
    recorded = read_arrays(run / "evaluate/walk.npz")
    walk = walk_video.Walk(*(recorded[name] for name in walk_video.Walk._fields))
    buffer = io.BytesIO()
    walk_video.write(buffer, walk, room, eyes, seconds, float(calibration["overlap"]))
    return _inline("video/mp4", buffer.getvalue())


def _size() -> dict[str, float]:
    """Measure how long and how wide is what can be seen of the robot when it stands [m]."""
    starts, ends, _, _, radii, _ = walk_video.bodies(hexapod.load().key("stance").qpos[None])
    tips, thick = np.stack([starts[0], ends[0]]), radii[:, None]
    length, width, _ = np.max(tips + thick, axis=(0, 1)) - np.min(tips - thick, axis=(0, 1))
    return {"length": float(length), "width": float(width)}


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PACKAGE / "pipeline" / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": _number, "fixed": _fixed}
    return environment


def _number(value: float, digits: int = 3) -> str:
    """Write a number to so many significant digits, as short as it goes; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-").replace("-", MINUS)


def _fixed(value: float, decimals: int) -> str:
    """Write a number to so many decimals; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", MINUS)  # + 0.0 makes -0 plain 0


def _inline(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
