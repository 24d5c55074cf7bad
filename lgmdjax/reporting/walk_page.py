"""A walk as one self-contained HTML page with robot and room in 3D, which can be rotated and played at any speed.

The page holds viser's client and the scene, and needs neither a server nor the network. It shows every second frame of
the walk, the path and the contacts; the curves and the eyes' pictures are in the video (`walk_video`).
"""

import html
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from lgmdjax.body.robot_xml import Body
from lgmdjax.errors import InputError
from lgmdjax.reporting import selection, walk_scene
from lgmdjax.reporting.playback import FRAME_RATE, Playback
from lgmdjax.reporting.room_shape import centres_during, shape_of
from lgmdjax.reporting.walk_scene import HAS_VISER as HAS_VISER
from lgmdjax.reporting.walk_scene import WalkScene
from lgmdjax.runtime.partial_files import replacing
from lgmdjax.simulation.closed_loop import Record, Room
from lgmdjax.world.arena import Arena

STRIDE = 2  # recorded frames per frame of the page
MAX_SECONDS = 60.0


@dataclass(frozen=True)
class WalkPage:
    """A page about a walk; a notebook shows it inline."""

    html: str
    height: int = 480  # px, in a notebook

    def _repr_html_(self) -> str:
        """Return an iframe that holds the page."""
        escaped = html.escape(self.html, quote=True)
        return f'<iframe srcdoc="{escaped}" width="100%" height="{self.height}" style="border:1px solid #ddd"></iframe>'

    def write(self, path: Path | str) -> Path:
        """Write the page, whole or not at all, and return its path."""
        with replacing(Path(path)) as partial:
            partial.write_text(self.html, encoding="utf-8")
        return Path(path)


def walk_page(
    record: Record,
    room: Room | Arena,
    *,
    index: int | None = None,
    seconds: float = 15.0,
    follow: bool = False,
    body: Body | None = None,
) -> WalkPage:
    """Return a page about one walk of a record, of the part that `selection.select_segment` selects.

    Raises InputError if the extra `viewer` is not installed.

    Args:
        record: recorded walks, axes (robot, frame), or one walk, axis (frame,).
        room: the rooms of the walks, or a single room for all of them.
        index: number of the robot to show; by default that of `selection.select_walk`.
        seconds: duration of the part, `MAX_SECONDS` at most.
        follow: keep the robot in the middle; otherwise the page shows the whole room.
        body: of the robot that walked, `robot.body`; the package's if None.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.random_rooms(jax.random.key(0), 4)
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    lj.walk_page(record, rooms)  # the last line of a notebook's cell: the walk in 3D
    ```
    """
    walk, scene = selection.choose_walk(record, room, index)
    if not 0 < seconds <= MAX_SECONDS:
        raise InputError(f"expected seconds above 0 and up to {MAX_SECONDS:g}, got {seconds}; choose another duration")
    frames = selection.select_segment(np.asarray(walk.position), np.asarray(walk.velocity), round(seconds * FRAME_RATE))
    part = jax.tree.map(lambda leaf: leaf[frames], walk)
    return page_of(to_playback(part, scene), follow=follow, body=body)


def to_playback(walk: Record, room: Arena) -> Playback:
    """Convert one walk, axis (frame,), to a `Playback` without pictures."""
    joints = np.asarray(walk.joints).reshape(len(walk.time), -1)
    return Playback(
        title="walk",
        room=shape_of(room),
        centres=centres_during(room, np.asarray(walk.time)),
        time=np.asarray(walk.time),
        qpos=np.concatenate([walk.position, walk.quaternion, joints], axis=1),
        u=np.asarray(walk.u),
        velocity=np.asarray(walk.velocity),
        contact=np.asarray(walk.contact),
        is_first=np.asarray(walk.is_first),
    )


def page_of(playback: Playback, *, follow: bool = False, body: Body | None = None) -> WalkPage:
    """Return a page about a whole walk."""
    if not np.all(np.isfinite(playback.qpos)):
        raise InputError("expected a walk with finite poses, got one without; choose another walk")
    server = walk_scene.quiet_server("127.0.0.1", 0)  # viser has no scene without a server
    try:
        scene = WalkScene(server, body)
        scene.follows = follow
        scene.set_room(playback.room, playback.centres_at(0))
        scene.trace(playback)
        scene.point_camera(playback.room)
        recording = server.get_scene_serializer()
        for frame in range(0, len(playback.time), STRIDE):
            scene.show(playback.qpos[frame], playback.centres_at(frame))
            recording.insert_sleep(STRIDE / FRAME_RATE)
        return WalkPage(recording.as_html())
    finally:
        server.stop()
