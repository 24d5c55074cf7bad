"""Stage report: one self-contained page about a run, for readers who do not know the project.

The page is made from files of the run folder only, and all its numbers come from them. Pictures and video are embedded,
so that it works offline. A page is written whole or not at all.

| section       | made from                                                                   |
| ------------- | --------------------------------------------------------------------------- |
| result, video | evaluate/evaluation.json, evaluate/walk.npz                                 |
| gait          | fit-gait/gait.json, fit-gait/cpg.npz, fit-gait/foot.npz                     |
| detectors     | evaluate/layers.npz, collect/calibration.json                               |
| learning      | train/training.json, train/prediction.npz                                   |
| walking       | evaluate/evaluation.json, evaluate/kinds.json, evaluate/trajectories.npz    |
| experiments   | evaluate/evaluation.json, evaluate/<trial>.svg                              |
| studies       | <study>/<study>.json, where the scale has studies                           |
| how made      | run.json, the done.json of each stage                                       |
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np

from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body
from lgmdjax.errors import InputError
from lgmdjax.evaluation import collision_causes, trials
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.pipeline import report_data, report_figures
from lgmdjax.pipeline.report_figures import NOMINAL_SPEED, TITLES, VARIANTS
from lgmdjax.pipeline.settings import ReportSettings
from lgmdjax.reporting import pages, robot_shape, walk_page
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import partial_files
from lgmdjax.runtime.storage import JsonObject, read_arrays, read_file
from lgmdjax.simulation.closed_loop import Record
from lgmdjax.studies import supervision, velocity
from lgmdjax.world import arena, scenes

WALK_PAGE, WALK_SECONDS = "walk.html", 30.0  # file next to index.html, and duration of the walk in it [s]
INPUTS = {  # of the policies
    "teacher": "laser scanner",
    "learned": "both LGMDs",
    "blind": "none",
    "direct": "both LGMDs",
    "random": "none",
}


def run(folder: Path, inputs: Mapping[str, Path], settings: ReportSettings, seed: int) -> None:
    """Write index.html from the folders of all earlier stages, and walk.html if the extra `viewer` is installed."""
    if walk_page.HAS_VISER:
        walk = Record(**read_arrays(folder.parent / "evaluate/walk.npz"))
        body, room = robot_xml.read_body(inputs["fit-gait"]), scenes.testing_room()
        walk_page.walk_page(walk, room, seconds=WALK_SECONDS, body=body).write(folder / WALK_PAGE)
    render(folder.parent, folder, video_seconds=settings.video_seconds)


def render(
    run_folder: Path,
    out: Path | None = None,
    *,
    room: arena.Arena | None = None,
    video_seconds: float = 10.0,
) -> Path:
    """Write the page of a run folder; return its path.

    Args:
        run_folder: the run folder, with every earlier stage done.
        out: folder for index.html; report/ in the run folder if not given.
        room: the room of the testing walks; the paper's testing room if not given.
        video_seconds: duration of the video.

    Raises InputError if a file is missing or cannot be read; the message names the stage that makes it.
    """
    room = scenes.testing_room() if room is None else room
    out = run_folder / "report" if out is None else out
    environment = pages.environment(PACKAGE_DIR / "pipeline" / "templates")
    environment.filters["number"] = _number
    page = environment.get_template("report.html.j2")
    walk_link = WALK_PAGE if (out / WALK_PAGE).is_file() else None
    try:
        text = page.render(**_contents(run_folder, room, video_seconds), walk_page=walk_link)
    except (KeyError, jinja2.UndefinedError) as error:
        raise InputError(
            f"expected a run folder of this version of lgmdjax, got {run_folder} without {error}; "
            "delete it and run again"
        ) from error
    out.mkdir(parents=True, exist_ok=True)
    path = out / "index.html"
    with partial_files.replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def _contents(run_folder: Path, room: arena.Arena, video_seconds: float) -> JsonObject:
    """Return all variables of the template."""
    results = report_data.read_results(run_folder)
    body = robot_xml.read_body(run_folder / "fit-gait")
    onset, layers = read_arrays(run_folder / "fit-gait/cpg.npz"), read_arrays(run_folder / "evaluate/layers.npz")
    camera_params = report_data.testing_camera(results, body)
    return {
        **results._asdict(),
        "figures": _figures(run_folder, results, onset, room),
        "video": pages.inline("video/mp4", report_figures.render_video(run_folder, camera_params, room, video_seconds)),
        "camera_params": camera_params,
        "layers_size": list(reversed(layers["picture"].shape)),
        "rounds": results.settings["train"].get("dagger_rounds", 0),
        "onset": {name: float(onset[name]) for name in ("period", "transient_cycles")},
        "verdicts": {trial: report_data.verdict(scores) for trial, scores in results.scores.items()},
        "causes": {trial: counts for trial, counts in results.causes.items() if any(counts.values())},
        "coarse": report_data.coarse_pictures(results.settings),
        "versions": report_data.versions(results.stages),
        **_study_contents(results.studies),
        **_names(),
        "robot_size": _robot_size(body),
    }


def _figures(
    run_folder: Path, results: report_data.Results, onset: Mapping[str, np.ndarray], room: arena.Arena
) -> dict[str, str]:
    """Return all figures as data URLs, by name."""
    figures = {
        **report_figures.plot_gait(run_folder, results.gait, onset),
        **report_figures.plot_detection(run_folder, results.calibration),
        **report_figures.plot_learning(run_folder, results.training),
        **report_figures.plot_walks(run_folder, results.scores, room),
        **{name: report_data.STUDIES[name].plot(rows) for name, rows in results.studies.items()},
    }
    pictures = {name: style.to_svg(figure) for name, figure in figures.items()}
    pictures |= {trial: read_file(run_folder / f"evaluate/{trial}.svg") for trial in results.outcomes}
    return {name: pages.inline("image/svg+xml", picture) for name, picture in pictures.items()}


def _study_contents(studies: Mapping[str, Sequence[JsonObject]]) -> JsonObject:
    """Return what the page says about the studies in addition to their figures."""
    return {
        "best_velocity": velocity.best_row(studies["velocity"]) if "velocity" in studies else None,
        "paper_best": velocity.PAPER_BEST,
        "cases": supervision.pool_repeats(studies.get("supervision", [])),
    }


def _names() -> JsonObject:
    """Return what the page says in every run: titles and meanings."""
    return {
        "titles": TITLES,
        "trials": trials.TRIALS,
        "inputs": INPUTS,
        "variants": VARIANTS,
        "cause_meanings": collision_causes.CAUSES,
        "nominal": NOMINAL_SPEED,
    }


def _robot_size(body: Body | None) -> dict[str, float]:
    """Measure length and width of the standing robot's visible parts, and the distance of its eyes [m]."""
    stance = robot_xml.compiled(body).key("stance").qpos
    starts, ends, eyes, _, radii, _ = robot_shape.body_geometry(stance[None], body)
    tips, thick = np.stack([starts[0], ends[0]]), radii[:, None]
    length, width, _ = np.max(tips + thick, axis=(0, 1)) - np.min(tips - thick, axis=(0, 1))
    return {"length": float(length), "width": float(width), "eyes": float(np.linalg.norm(eyes[0, 0] - eyes[0, 1]))}


def _number(value: float, digits: int = 3) -> str:
    """Format a number with some significant digits, without trailing zeros; a dash if it is not finite.

    >>> _number(0.041999), _number(float("nan"))
    ('0.042', '–')
    """
    if value is None or not math.isfinite(value):
        return "–"
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-").replace("-", pages.MINUS)
