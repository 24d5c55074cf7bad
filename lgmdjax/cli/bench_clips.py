"""`lgmdjax bench clips FOLDER [labels.csv]`: looming detectors on labelled videos.

Writes to a folder with the name of the clips' folder:

| file          | content                                                                       |
| ------------- | ----------------------------------------------------------------------------- |
| index.html    | tables, ROC, and the responses to every clip below its pictures               |
| scores.md     | the tables as Markdown                                                        |
| scores.json   | all scores, with the settings and the onsets of the alarms, and versions      |
| roc.png       | hits against false alarms for every threshold                                 |
| responses.csv | u, excitation, adapted response and whole-field change of every frame         |
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from tqdm import tqdm

from lgmdjax.bench.tables import Table
from lgmdjax.cli.flags import AlarmFlags, BenchFlags
from lgmdjax.detectors import alarm
from lgmdjax.errors import InputError, one_line
from lgmdjax.evaluation import clip_labels, clip_responses, clip_scores, stimulus_scores
from lgmdjax.evaluation.clip_labels import Label
from lgmdjax.evaluation.clip_responses import Clip, Trace
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.reporting import pages
from lgmdjax.reporting.figures import clip_scores as figure
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import partial_files, storage, versions
from lgmdjax.runtime.storage import JsonObject

SCALES = {"own": "u", "adapted": "adapted"}  # name in scores.json: field of `Trace`
FIXED = clip_scores.Setting(AlarmFlags.threshold, AlarmFlags.persistence)  # defaults of `lgmdjax watch`
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")
COLUMNS = ("detector", "AUC u", "AUC adapted", "peak at contact", "hits", "false alarms / min", "lead [s]", "halves")
Traces = Mapping[str, Sequence[Trace]]
"""Responses by detector, to each clip."""


def run_clips(flags: BenchFlags) -> Iterator[str]:
    """Score the detectors; yield a line about each, then the names of the files."""
    folder, labels = read_arguments(flags.paths)
    names = stimulus_scores.choose_seeing(flags.detector)
    clips = [clip_responses.read_clip(folder, label) for label in tqdm(labels, desc="read", unit="clip")]
    traces: dict[str, list[Trace]] = {}
    rows: list[JsonObject] = []
    for name in names:
        contestant = stimulus_scores.get_detector(name)
        traces[name] = [clip_responses.respond(contestant, clip) for clip in clips]
        rows.append(score(name, clips, traces[name]))
        yield _line(rows[-1])
    out = folder_of(flags)
    with partial_files.replacing_all(out) as partial:
        storage.write_json(partial / "scores.json", {"versions": versions.installed(), "rows": rows})
        (partial / "roc.png").write_bytes(style.to_png(figure.plot_roc(rows)))
        (partial / "scores.md").write_text(table(rows).markdown(), encoding="utf-8")
        with (partial / "responses.csv").open("wb") as file:
            pyarrow.csv.write_csv(_tabulate(clips, traces), file)
        (partial / "index.html").write_text(_page(clips, rows, traces), encoding="utf-8")
    for written in ("index.html", "scores.md", "scores.json", "roc.png", "responses.csv"):
        yield str(out / written)


def folder_of(flags: BenchFlags) -> Path:
    """Return the folder of the results."""
    return flags.out / f"clips-{flags.paths[0].resolve().name}"


def read_arguments(paths: Sequence[Path]) -> tuple[Path, list[Label]]:
    """Return the folder of the clips and their labels; note on stderr which videos have none."""
    if not 1 <= len(paths) <= 2:
        raise InputError(f"expected bench clips FOLDER [labels.csv], got {len(paths)} paths; name a folder of videos")
    folder = paths[0]
    if not folder.is_dir():
        raise InputError(f"expected a folder of videos, found none at {folder}; check the path")
    labels = clip_labels.read_labels(paths[1] if len(paths) == 2 else folder / "labels.csv")
    missing = [label.clip for label in labels if not (folder / label.clip).is_file()]
    if missing:
        raise InputError(f"expected all labelled clips in {folder}, found no {', '.join(missing)}; correct the labels")
    videos = {path.name for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES}
    unlabelled = sorted(videos - {label.clip for label in labels})
    if unlabelled:
        print(one_line(f"note: no label for {', '.join(unlabelled)}; add rows to score them"), file=sys.stderr)
    unusual = sorted({label.kind for label in labels} - {*clip_labels.APPROACHING, *clip_labels.OTHERS})
    if unusual:
        note = f"note: clips of kind {', '.join(unusual)} should raise no alarm; check the spelling"
        print(one_line(note), file=sys.stderr)
    return folder, labels


def score(name: str, clips: Sequence[Clip], traces: Sequence[Trace]) -> JsonObject:
    """Return the scores of a detector's u, and of its adapted response."""
    row: JsonObject = {"detector": name, "clips": [clip.label.clip for clip in clips]}
    for scale, field in SCALES.items():
        series = [
            clip_scores.Series(clip.label, clip.rate, clip.time, getattr(trace, field))
            for clip, trace in zip(clips, traces, strict=True)
        ]
        row[scale] = clip_scores.score(series)
        if scale == "adapted":
            row[scale]["fixed"] = clip_scores.score_fixed(series, FIXED)
    return row


def _line(row: JsonObject) -> str:
    left_out = row["adapted"]["leave_one_out"]
    own, adapted = (_number(row[scale]["auc"]) for scale in SCALES)
    return (
        f"{row['detector']}: area under ROC {own} (u), {adapted} (adapted); "
        f"leave-one-out {left_out['hits']} of {left_out['approaches']} hits, {left_out['false_alarms']} false alarms"
    )


def table(rows: Sequence[JsonObject]) -> Table:
    """Return the scores as a table, a row for each detector; alarms on the adapted response, leave-one-out."""
    return Table(COLUMNS, [_cells(row) for row in rows])


def _cells(row: JsonObject) -> tuple[str, ...]:
    own, adapted = row["own"], row["adapted"]
    scores, halves = adapted["leave_one_out"], adapted["halves"]
    rate, lead = scores["false_alarms_a_minute"], scores["lead"]
    return (
        row["detector"],
        _number(own["auc"]),
        _number(adapted["auc"]),
        f"{own['peaks_at_contact']}, {adapted['peaks_at_contact']} of {own['contacts']}",
        f"{scores['hits']} of {scores['approaches']}",
        f"{_number(rate['value'], 1)} ({_number(rate['low'], 1)} to {_number(rate['high'], 1)})",
        f"{_number(lead['value'])} ({_number(lead['low'])} to {_number(lead['high'])})",
        f"{halves['hits']} hits, {halves['false_alarms']} false",
    )


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _tabulate(clips: Sequence[Clip], traces: Traces) -> pa.Table:
    """Return the responses, a row for each detector, clip and frame."""
    parts = []
    for name, responses in traces.items():
        for clip, trace in zip(clips, responses, strict=True):
            frames = len(clip.time)
            columns = {"detector": [name] * frames, "clip": [clip.label.clip] * frames, "frame": np.arange(frames)}
            parts.append(pa.table(columns | {"time": clip.time} | vars(trace)))
    return pa.concat_tables(parts)


def _page(clips: Sequence[Clip], rows: Sequence[JsonObject], traces: Traces) -> str:
    labels = [clip.label for clip in clips]
    found = versions.installed()
    drawings = [_draw(k, clip, rows, traces) for k, clip in enumerate(clips)]
    template = pages.environment(PACKAGE_DIR / "reporting" / "templates").get_template("clips.html.j2")
    return template.render(
        {
            "labels": labels,
            "approaches": sum(label.is_approach for label in labels),
            "contacts": sum(label.contact is not None for label in labels),
            "cells": (clip_responses.WIDTH, clip_responses.HEIGHT),
            "alarm": alarm.Params(threshold=FIXED.threshold, persistence=FIXED.persistence),
            "window": clip_scores.WINDOW,
            "tolerance": clip_scores.PEAK_TOLERANCE,
            "rows": rows,
            "roc": pages.inline("image/png", style.to_png(figure.plot_roc(rows))),
            "traces": [pages.inline("image/png", drawing) for drawing in drawings],
            "version": found["lgmdjax"],
            "jax_version": found["jax"],
        }
    )


def _draw(k: int, clip: Clip, rows: Sequence[JsonObject], traces: Traces) -> bytes:
    """Return the figure of clip k."""
    responses = {
        row["detector"]: figure.Responses(
            traces[row["detector"]][k].u.tolist(),
            traces[row["detector"]][k].adapted.tolist(),
            row["adapted"]["alarms"][k],
            row["adapted"]["setting"]["threshold"],
        )
        for row in rows
    }
    low, high = clip_scores.window(clip.label)
    window = (low, high) if clip.label.is_approach else None
    view = figure.ClipView(clip.label.clip, clip.time.tolist(), clip.thumbnails, window, clip.label.contact)
    return style.to_png(figure.plot_clip(view, responses), dpi=120)
