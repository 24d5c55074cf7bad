"""Files of `lgmdjax watch` except the overlay: table, plot, and list of alarms."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from matplotlib.figure import Figure

from lgmdjax import __version__
from lgmdjax.detectors import alarm, lgmd
from lgmdjax.reporting import lgmd_overlay
from lgmdjax.reporting.figures import style
from lgmdjax.runtime import storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield

TableFormat = Literal["csv", "parquet"]
UNITS = {
    "time": "s",
    "u": "1, from 0.5 (still) to 1",
    "feed_forward": "grey level",
    "excitation": "grey level",
    "adapted": "1, 0.5 if the excitation is as in the last seconds, 0.667 if it has doubled",
    "alarm": "0 or 1",
}


class Detectors(NamedTuple):
    """Constants of the detector and the alarm of each eye; the alarm's frame time is that of the video."""

    lgmd: lgmd.Params
    alarm: alarm.Params


class Responses(NamedTuple):
    """Responses of both eyes to the frames of a video."""

    samples: list[lgmd_overlay.ResponseSample]
    excitations: list[tuple[float, float]]


def write_files(
    folder: Path, seen: Responses, params: Detectors, facts: JsonObject, table: TableFormat
) -> list[JsonObject]:
    """Write table, plot and list of alarms to a folder, and return the alarms.

    Args:
        folder: existing folder.
        seen: responses of all frames.
        params: of the detectors.
        facts: further metadata: `video`, `rate` [frames a second], `eyes`.
        table: format of the table.
    """
    constants = {name: float(getattr(params.lgmd, name)) for name in lgmd.SCALARS}
    raised = {name: float(value) for name, value in vars(params.alarm).items()}
    field = {"pooling": params.lgmd.pooling, "falloff": params.lgmd.falloff}
    facts = facts | {"eyes": facts["eyes"] | field, "lgmd": constants, "alarm": raised}
    alarms = list_alarms(seen.samples, 1 / facts["rate"])
    responses = _table(seen, facts | {"units": UNITS})
    _write_table(responses, folder, table)
    storage.write_json(folder / "alarms.json", {"alarms": alarms, "lgmdjax": __version__, **facts})
    (folder / "response.png").write_bytes(style.to_png(plot(responses, params)))
    return alarms


def list_alarms(samples: Sequence[lgmd_overlay.ResponseSample], frame_time: float) -> list[JsonObject]:
    """Return start and end [s] of every alarm, and the largest adapted response in it; a short gap does not end it.

    >>> first = lgmd_overlay.ResponseSample(0.0, (0.9, 0.5), (1.0, 1.0), (0.8, 0.4), is_alarm=True)
    >>> list_alarms([first, first._replace(time=0.1, is_alarm=False)], 0.1)
    [{'start': 0.0, 'end': 0.1, 'adapted': 0.8}]
    """
    alarms: list[JsonObject] = []
    for sample in (sample for sample in samples if sample.is_alarm):
        if not alarms or sample.time - alarms[-1]["end"] > alarm.GAP:
            alarms.append({"start": sample.time, "end": sample.time, "adapted": 0.0})
        alarms[-1]["end"] = sample.time + frame_time
        alarms[-1]["adapted"] = max(alarms[-1]["adapted"], *sample.adapted)
    return alarms


def _write_table(responses: pa.Table, folder: Path, table: TableFormat) -> None:
    """Write the responses; the file is opened here, because Arrow refuses names that are not UTF-8."""
    with (folder / f"response.{table}").open("wb") as file:
        if table == "csv":
            pyarrow.csv.write_csv(responses, file)
        else:
            pyarrow.parquet.write_table(responses, file)


@style.styled
def plot(responses: pa.Table, params: Detectors) -> Figure:
    """Plot u, adapted response and FF of both eyes over time, the alarms, and T_f, above which FF suppresses u."""
    figure = Figure(figsize=(style.WIDTH, 4.8))
    upper, middle, lower = figure.subplots(3, 1, sharex=True)
    time, is_alarm = responses["time"].to_numpy(), responses["alarm"].to_numpy() > 0
    for side, colour in zip(hemifield.SIDES, (style.LEFT_COLOUR, style.RIGHT_COLOUR), strict=True):
        upper.plot(time, responses[f"u_{side}"].to_numpy(), color=colour, label=f"{side} eye")
        middle.plot(time, responses[f"adapted_{side}"].to_numpy(), color=colour)
        lower.plot(time, responses[f"feed_forward_{side}"].to_numpy(), color=colour)
    middle.axhline(float(params.alarm.threshold), color=style.GREY, linestyle=":", label="threshold")
    middle.fill_between(time, 0, 1, where=is_alarm.tolist(), step="mid", color=style.RED, alpha=0.3, label="alarm")
    lower.axhline(float(params.lgmd.suppression), color=style.GREY, linestyle=":", label="T_f")
    upper.set(ylabel="u", ylim=(0.48, 1.02), title="response of the two LGMDs")
    middle.set(ylabel="adapted response", ylim=(0, 1))
    middle.legend(loc="lower left", ncols=2)
    lower.set(ylabel="FF [grey levels]", xlabel="time [s]")
    upper.legend(loc="upper left", ncols=2)
    lower.legend(loc="upper left")
    return figure


def _table(seen: Responses, facts: JsonObject) -> pa.Table:
    """Return the responses as a table with one row for each frame, with the facts as JSON in its metadata."""
    samples = seen.samples
    columns: dict[str, object] = {"frame": range(len(samples)), "time": [sample.time for sample in samples]}
    for side, name in enumerate(hemifield.SIDES):
        columns[f"u_{name}"] = [sample.u[side] for sample in samples]
        columns[f"feed_forward_{name}"] = [sample.feed_forward[side] for sample in samples]
        columns[f"excitation_{name}"] = [pair[side] for pair in seen.excitations]
        columns[f"adapted_{name}"] = [sample.adapted[side] for sample in samples]
    columns["alarm"] = [int(sample.is_alarm) for sample in samples]
    metadata = {name: fact if isinstance(fact, str) else json.dumps(fact) for name, fact in facts.items()}
    metadata["lgmdjax"] = __version__
    return pa.table({name: pa.array(values) for name, values in columns.items()}, metadata=metadata)
