"""The card of a data set (README.md): what it holds, how it was made, columns with units, licence.

Its first lines are the metadata that Hugging Face's hub reads from a card.
"""

import json
from collections.abc import Sequence

import numpy as np

from lgmdjax.datasets.formats import DatasetFormat
from lgmdjax.datasets.lerobot_features import CAMERAS, FEATURES, INDICES, TASK, unit_of
from lgmdjax.datasets.pictures import RecordedCamera
from lgmdjax.datasets.recorded import Recording, cut_episodes
from lgmdjax.runtime import versions
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episode_tables import COLUMNS, FIELDS, MEANINGS, ORIGIN, ORIGIN_MEANINGS, UNITS

FILE = "README.md"
LICENCE = "Apache-2.0"  # of this package, and of the walks that come with it
FRAMES = """\
World frame: x forward, y left, z up; the floor is z = 0. Left comes before right. A velocity of 1 is 0.05 m/s of that
side's legs. Grey is 0 (black) to 255 (white).
"""
LIMITS = """\
Everything is simulated: MuJoCo's contacts, rendered pictures, a laser scanner without noise. After a contact the robot
is moved to another start at once (`resets`). Frames that are not `ok` hold the pose in which a robot fell.
"""


def describe(recording: Recording, name: str, format: DatasetFormat, eyes: RecordedCamera | None, licence: str) -> str:
    """Return the card as Markdown."""
    columns = {"lerobot": _lerobot_rows, "zarr": _zarr_rows}.get(format, _table_rows)(eyes)
    parts = [
        _front_matter(format, licence),
        f"# Walks of a hexapod robot with two looming detectors: {name}\n",
        _what(recording, eyes),
        f"## How it was made\n\n{_how(recording, eyes)}",
        f"## Columns\n\n{FRAMES}\n{_table(('column', 'unit', 'meaning'), columns)}",
        f"## Limits\n\n{LIMITS}",
        f"## Licence\n\n{licence}.\n",
    ]
    return "\n".join(parts)


def _front_matter(format: DatasetFormat, licence: str) -> str:
    lines = [
        "---",
        f"license: {licence.lower()}",
        "task_categories: [robotics]",
        "tags: [robotics, simulation, hexapod]",
    ]
    if format == "lerobot":
        lines[-1] = "tags: [LeRobot, robotics, simulation, hexapod]"
        lines += ["configs:", "- config_name: default", "  data_files: data/*/*.parquet"]
    return "\n".join([*lines, "---", ""])


def _what(recording: Recording, eyes: RecordedCamera | None) -> str:
    walks = recording.walks
    frames = sum(map(len, walks))
    episodes, contacts = len(cut_episodes(walks)), sum(int(np.sum(walk.contact)) for walk in walks)
    facts = [
        ("walks", f"{len(walks)}, of {len({walk.room for walk in walks})} rooms"),
        ("frames", f"{frames} at {FRAME_RATE:g} Hz: {frames / FRAME_RATE / 60:.1f} min"),
        ("from a start to a contact or the end", f"{episodes} pieces"),
        ("contacts", str(contacts)),
        ("pictures", "none" if eyes is None else f"both eyes, {eyes.settings.width} x {eyes.settings.height} px, grey"),
    ]
    return f"{TASK}\n\n{_table(('what', 'how many'), facts)}"


def _how(recording: Recording, eyes: RecordedCamera | None) -> str:
    header, seeds = recording.header, sorted({walk.seed for walk in recording.walks})
    recorder = ", ".join(f"{name} {version}" for name, version in header.get("versions", {}).items())
    facts = [
        ("seed of the rooms", ", ".join(map(str, seeds))),
        ("recorded by", recorder or "unknown versions"),
        ("exported by", f"lgmdjax {versions.installed()['lgmdjax']}"),
    ]
    if eyes is not None:
        facts.append(("pictures", "rendered again from the recorded poses; the detectors give the recorded u for them"))
    recorded_with = json.dumps(recording.parameters, indent=2)
    return f"{_table(('what', 'value'), facts)}\nRecorded with\n\n```json\n{recorded_with}\n```\n"


def _table_rows(eyes: RecordedCamera | None) -> list[tuple[str, str, str]]:
    return [(name, UNITS.get(name, "-"), MEANINGS[name]) for name in COLUMNS]


def _zarr_rows(eyes: RecordedCamera | None) -> list[tuple[str, str, str]]:
    rows = [(name, "-", ORIGIN_MEANINGS[name]) for name in ORIGIN]
    rows += [(name, field.unit or "-", field.meaning) for name, field in FIELDS.items()]
    if eyes is not None:
        rows.append(("pictures_left, pictures_right", "grey", "pictures of both eyes, row 0 at the top"))
    return rows


def _lerobot_rows(eyes: RecordedCamera | None) -> list[tuple[str, str, str]]:
    rows = [
        (name, unit_of(name) or "-", "; ".join(FIELDS[part].meaning for part in parts))
        for name, parts in FEATURES.items()
    ]
    rows += [(camera, "1", "picture, 0 to 1 as LeRobot reads it, three equal channels") for camera in CAMERAS if eyes]
    return rows + [(name, unit_of(name) or "-", "as LeRobot defines it") for name in INDICES]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
