"""The features of walks as a LeRobotDataset, with their names and units (`lgmdjax.datasets.lerobot`)."""

from collections.abc import Mapping

from lgmdjax.body import hexapod
from lgmdjax.datasets.pictures import RecordedCamera
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import hemifield
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.simulation.episode_tables import FIELDS

VERSION = "v3.0"
TASK = "Walk on through the room and touch nothing."
FILES_PER_CHUNK = 1000

FEATURES: Mapping[str, tuple[str, ...]] = {
    "observation.state": ("joints",),
    "pose": ("position", "quaternion"),
    "observation.lgmd": ("u",),
    "observation.feed_forward": ("feed_forward",),
    "observation.excitation": ("excitation",),
    "laser.distance": ("distances",),
    "laser.corridor": ("corridor",),
    "action": ("velocity",),
    "teacher.velocity": ("label",),
    "clearance": ("clearance",),
    "contact": ("contact",),
}
"""The fields of `Record` in each feature. LeRobot gives a policy the features that begin with "observation"."""
CAMERAS = tuple(f"observation.images.{side}" for side in hemifield.SIDES)
INDICES = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"}
INDICES |= {"task_index": "int64", "next.done": "bool"}
"""Features that LeRobot requires, and the end of an episode."""


def info(episodes: int, frames: int, eyes: RecordedCamera | None) -> JsonObject:
    """Return meta/info.json of a data set with this many episodes and frames."""
    features: JsonObject = {name: _describe(name) for name in FEATURES}
    if eyes is not None:
        features |= {camera: _describe_video(eyes) for camera in CAMERAS}
    for name, dtype in INDICES.items():
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": "lgmdjax hexapod",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": FILES_PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(FRAME_RATE),
        "splits": {"train": f"0:{episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None if eyes is None else "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


def _describe(name: str) -> JsonObject:
    fields = [FIELDS[part] for part in FEATURES[name]]
    names = [column for one in fields for column in one.columns]
    if name == "observation.state":
        names = [f"{leg}_{joint}" for leg in hexapod.LEGS for joint in hexapod.JOINTS]
    dtype = "bool" if fields[0].kind == "b" else "float32"
    info = {"unit": unit_of(name), "meaning": "; ".join(one.meaning for one in fields)}
    return {"dtype": dtype, "shape": [len(names)], "names": names, "info": info}


def _describe_video(eyes: RecordedCamera) -> JsonObject:
    height, width = eyes.settings.height, eyes.settings.width
    info = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": round(FRAME_RATE),
        "video.channels": 3,
        "has_audio": False,
    }
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def unit_of(name: str) -> str:
    """Return the unit of a feature; of several fields, each field's."""
    if name == "timestamp":
        return "s"
    return ", ".join(FIELDS[part].unit for part in FEATURES.get(name, ()))
