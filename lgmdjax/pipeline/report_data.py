"""Contents of a run folder for the report page, with the names of this version, and values derived from them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body
from lgmdjax.pipeline.report_figures import TITLES
from lgmdjax.runtime.run_folders import read_facts
from lgmdjax.runtime.storage import JsonObject, read_json, read_table
from lgmdjax.sensors import camera
from lgmdjax.studies import errata, failure_modes, sensitivity, supervision, velocity

STAGES = ("fit-gait", "collect", "train", "evaluate")  # names of their folders and commands
STUDIES = {
    "velocity": velocity,
    "supervision": supervision,
    "errata": errata,
    "failure_modes": failure_modes,
    "sensitivity": sensitivity,
}
FORMER_NAMES = {  # in settings and rows of studies of version 0.1.0
    "places": "trials",
    "rounds": "dagger_rounds",
    "teaching": "supervision",
    "printed": "errata",
    "failures": "failure_modes",
    "bench": "benchmark",
    "driver": "policy",
    "start": "repeat",
    "place": "trial",
    "axis": "parameter",
    "chosen": "is_baseline",
}


class Results(NamedTuple):
    """Contents of the JSON files of a run folder."""

    facts: JsonObject  # run.json
    settings: JsonObject  # its settings, with the names of this version
    gait: JsonObject
    calibration: JsonObject
    training: JsonObject
    scores: dict[str, JsonObject]  # by trial and policy, of trials that continue after a collision
    outcomes: dict[str, JsonObject]  # of trials that end with the first contact
    causes: JsonObject  # number of collisions by trial and cause
    studies: dict[str, list[JsonObject]]  # rows of each study
    stages: list[JsonObject]  # done.json of each stage


def read_results(run_folder: Path) -> Results:
    """Read the JSON files of a run folder; those of version 0.1.0 get the names of this version."""
    facts, evaluation = read_facts(run_folder), read_table(run_folder / "evaluate/evaluation.json")
    settings = _with_present_names(facts["settings"])
    folders = {name: _study_folder(run_folder, name) for name in STUDIES if name in settings}
    stages = {stage: run_folder / stage for stage in STAGES} | folders
    scores = {trial: table for trial, table in evaluation.items() if "per_100_m" in next(iter(table.values()))}
    return Results(
        facts=facts,
        settings=settings,
        gait=read_table(run_folder / "fit-gait/gait.json"),
        calibration=read_json(run_folder / "collect/calibration.json"),
        training=read_table(run_folder / "train/training.json"),
        scores=scores,
        outcomes={trial: table for trial, table in evaluation.items() if trial not in scores},
        causes=read_json(run_folder / "evaluate/kinds.json"),
        studies={name: _with_present_names(read_table(path / f"{path.name}.json")) for name, path in folders.items()},
        stages=[{"name": name, **read_json(path / "done.json")} for name, path in stages.items()],
    )


def _study_folder(run_folder: Path, name: str) -> Path:
    """Return the folder of a study, which may have its name of version 0.1.0."""
    former = next((old for old, new in FORMER_NAMES.items() if new == name), name)
    return run_folder / (name if (run_folder / name).exists() else former)


def _with_present_names(content: Any) -> Any:
    """Replace names of version 0.1.0 by those of this version, in all objects of some JSON content."""
    if isinstance(content, list):
        return [_with_present_names(value) for value in content]
    if isinstance(content, dict):
        return {FORMER_NAMES.get(name, name): _with_present_names(value) for name, value in content.items()}
    return content


def testing_camera(results: Results, body: Body | None = None) -> camera.Params:
    """Return the camera of the learned policy in the testing room: the trial's resolution, the detectors' field."""
    mounts = None if body is None else robot_xml.sensor_mounts(body).eyes
    size = next(plan["eyes"] for plan in results.settings["evaluate"]["trials"] if plan["trial"] == "testing")
    field = {name: results.calibration[name] for name in ("overlap", "ground") if name in results.calibration}
    return camera.Params(width=size["width"], height=size["height"], mounts=mounts, **field)


def coarse_pictures(settings: JsonObject) -> dict[str, str]:
    """Return where pictures were smaller than the paper's, and their size."""
    train, plans = settings["train"].get("eyes"), settings["evaluate"]["trials"]
    sizes = {"in training": train} if train else {}
    sizes |= {f"in {TITLES[plan['trial']]}": plan["eyes"] for plan in plans}
    others = [plan["coarse"] for plan in plans if plan.get("coarse")]
    sizes |= {"for the other policies": others[0]} if others else {}
    studies = {name: settings[name] for name in STUDIES if name in settings}
    sizes |= {
        f"in the study {name}": study.get("eyes") or study["benchmark"]["eyes"] for name, study in studies.items()
    }
    full = camera.Params().width
    return {where: f"{size['width']} × {size['height']}" for where, size in sizes.items() if size["width"] < full}


def verdict(scores: JsonObject) -> JsonObject:
    """Compare the learned policy with walking blindly: ratio of rates, and whether the intervals are disjoint."""
    learned, blind = scores["learned"]["per_100_m"], scores["blind"]["per_100_m"]
    return {
        "ratio": learned["value"] / blind["value"] if blind["value"] else math.nan,
        "half": learned["value"] < 0.5 * blind["value"],
        "tenth": learned["value"] < 0.1 * blind["value"],
        "apart": learned["high"] < blind["low"],
    }


def versions(stages: Sequence[JsonObject]) -> dict[str, str]:
    """Return the version of each package that the stages ran with; if they differ, all of them with their stages.

    >>> versions([{"name": "collect", "versions": {"jax": "0.9.2"}}, {"name": "train", "versions": {"jax": "0.9.9"}}])
    {'jax': '0.9.2 (collect); 0.9.9 (train)'}
    """
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
