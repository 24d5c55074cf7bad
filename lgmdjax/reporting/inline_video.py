"""Video of a walk in the output of a notebook's cell."""

import io
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path

from lgmdjax.reporting import walk_video
from lgmdjax.simulation import assembly, closed_loop
from lgmdjax.simulation.closed_loop import Record, Room
from lgmdjax.world import arena

WIDTH = 720  # px, as notebooks show it


@dataclass(frozen=True, repr=False)
class InlineVideo:
    """An MP4 video that notebooks show with controls, embedded in their output."""

    data: bytes

    def _repr_html_(self) -> str:
        source = f"data:video/mp4;base64,{b64encode(self.data).decode()}"
        return f'<video controls loop muted width="{WIDTH}" src="{source}"></video>'

    def __repr__(self) -> str:
        return f"InlineVideo({len(self.data) / 1e6:.2f} MB)"

    def save(self, path: Path | str) -> Path:
        """Write the video to a file and return its path."""
        Path(path).write_bytes(self.data)
        return Path(path)


def show_walk(
    record: Record,
    room: Room | arena.Arena,
    robot: closed_loop.Params | None = None,
    *,
    index: int | None = None,
    seconds: float = 10.0,
) -> InlineVideo:
    """Return a video of one walk that plays in a notebook; arguments as those of `walk_video.write_video`.

    ```python
    import jax
    import lgmdjax as lj

    rooms = lj.random_rooms(jax.random.key(0), 4)
    record = lj.rollout(lj.load_robot(), rooms, seconds=30)
    lj.show_walk(record, rooms)
    ```
    """
    content, robot = io.BytesIO(), robot or assembly.load_robot()
    walk_video.write_trace(content, *walk_video.choose_trace(record, room, robot, index), seconds, body=robot.body)
    return InlineVideo(content.getvalue())
