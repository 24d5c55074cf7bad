"""A robot and its room in viser's scene, for the viewer and for pages without a server. Needs the extra `viewer`.

`mjviser` draws the robot from its MuJoCo model; walls, floor and obstacles are added here. To follow the robot, the
whole world is shifted, so that the robot stays where the camera looks and the user can still rotate the camera.
"""

from collections.abc import Callable, Sequence
from importlib.util import find_spec

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from lgmdjax.body import robot_xml
from lgmdjax.body.robot_xml import Body
from lgmdjax.errors import InputError
from lgmdjax.reporting.playback import Playback, RoomShape, contacts_of, path_of

if HAS_VISER := find_spec("viser") is not None and find_spec("mjviser") is not None:
    import mjviser
    import rich
    import trimesh
    import viser

BOX, CYLINDER, OVERHEAD, WALL, FLOOR = (
    (158, 186, 205),
    (214, 178, 132),
    (190, 190, 190),
    (225, 228, 235),
    (233, 228, 218),
)
PATH, CONTACT = (60, 110, 160), (193, 18, 31)
LINE_HEIGHT, MARK_HEIGHT = 0.006, 0.30  # m above the floor
CAMERA_OFFSET = np.array([-1.35, -0.95, 1.05])  # m, from the robot
OVERVIEW = np.array([-0.1, -1.15, 1.25])  # the same for the whole room, as multiples of its longest side
WORLD = "/world"  # everything that is shifted to follow the robot


def check_installed() -> None:
    """Raise `InputError` if viser or mjviser is missing."""
    if not HAS_VISER:
        raise InputError(
            "expected viser and mjviser to draw the robot in a browser, got an environment without them; "
            "pip install 'lgmdjax[viewer]'"
        )


def quiet_server(host: str, port: int, label: str | None = None) -> "viser.ViserServer":
    """Start viser's server without its messages."""
    check_installed()
    rich.get_console().quiet = True
    return viser.ViserServer(host=host, port=port, label=label, verbose=False)


def _light(server: "viser.ViserServer") -> None:
    """Light the scene without shadows and mjviser's environment map, which browsers without a GPU draw slowly."""
    server.scene.configure_environment_map(hdri=None)
    server.scene.configure_default_lights(enabled=False)
    server.scene.add_light_hemisphere("/lights/sky", intensity=2.2)
    for number, place in enumerate(((2.0, -3.0, 5.0), (-3.0, 2.0, 3.0))):
        server.scene.add_light_directional(f"/lights/{number}", intensity=1.6 - number, position=place)


class WalkScene:
    """A scene with one room and one robot."""

    def __init__(self, server: "viser.ViserServer", body: Body | None = None):
        self.server = server
        self.follows = True
        self.on_move: Callable[[int, float, float], None] | None = None  # (dragged obstacle, x, y [m])
        self._build(body)

    def set_body(self, body: Body | None) -> None:
        """Draw a robot with another body from now on; the room has to be set again."""
        if body != self.body:
            self.server.scene.reset()
            self._build(body)

    def _build(self, body: Body | None) -> None:
        self.body, self.model = body, robot_xml.compiled(body)
        self.data = mujoco.MjData(self.model)
        self._robot = mjviser.ViserMujocoScene(self.server, self.model, num_envs=1)
        self._robot.camera_tracking_enabled = False
        self._robot.geom_groups_visible[0] = False  # the floor and the barriers of the physics
        self._robot._sync_visibilities()
        self._world = self.server.scene.add_frame(WORLD, show_axes=False)
        _light(self.server)
        self._obstacles: dict[int, viser.MeshHandle] = {}
        self._heights: dict[int, float] = {}
        self._centres: Float[ndarray, "n 2"] = np.zeros((0, 2))
        self._offset = np.zeros(3)
        self._qpos = self.model.key("stance").qpos.copy()

    def set_room(self, room: RoomShape, centres: Float[ndarray, "n 2"]) -> None:
        """Replace the room by another one."""
        for name in ("walls", "floor", "obstacles", "paths", "contacts"):
            self.server.scene.remove_by_name(f"{WORLD}/{name}")
        self._obstacles.clear()
        self._draw_bounds(room)
        for index in np.flatnonzero(room.top > 0).tolist():
            self._draw_obstacle(room, index)
        self._centres = np.full_like(centres, np.nan)
        self.show(self._qpos, centres)

    def show(self, qpos: Float[ndarray, "25"], centres: Float[ndarray, "n 2"]) -> None:
        """Draw the robot in a pose, and the obstacles at their centres [m]."""
        self._qpos = np.asarray(qpos, float)
        self.data.qpos[:] = self._qpos
        mujoco.mj_kinematics(self.model, self.data)
        self._offset = np.array([-qpos[0], -qpos[1], 0.0]) if self.follows else np.zeros(3)
        self.data.xpos[1:] += self._offset
        with self.server.atomic():
            self._world.position = self._offset
            self._robot.update_from_mjdata(self.data)
            for index, handle in self._obstacles.items():
                if np.any(centres[index] != self._centres[index]):
                    handle.position = np.append(centres[index], self._heights[index])
        self._centres = np.array(centres)

    def trace(self, playback: Playback) -> None:
        """Draw the paths of a walk on the floor, and a mark where each contact began."""
        for number, path in enumerate(path_of(playback)):
            self._add_line(f"{WORLD}/paths/{number}", path, PATH)
        for number, frame in enumerate(contacts_of(playback)):
            self.mark(number, playback.qpos[frame, :2])

    def mark(self, number: int, where: Sequence[float] | ndarray) -> None:
        """Mark a contact with an obstacle."""
        x, y = map(float, where[:2])
        self.server.scene.add_icosphere(
            f"{WORLD}/contacts/{number}", radius=0.045, color=CONTACT, position=(x, y, MARK_HEIGHT)
        )
        stem = np.array([[x, y, 0.0], [x, y, MARK_HEIGHT]])
        self._add_line(f"{WORLD}/contacts/{number}/stem", stem - [x, y, MARK_HEIGHT], CONTACT)

    def clear_marks(self) -> None:
        """Remove paths and marks."""
        for name in ("paths", "contacts"):
            self.server.scene.remove_by_name(f"{WORLD}/{name}")

    def to_floor(self, origin: Sequence[float], direction: Sequence[float], height: float = 0.0) -> tuple[float, float]:
        """Return x, y [m] of the room where a ray of the browser meets the plane at some height."""
        start, along = np.asarray(origin, float) - self._offset, np.asarray(direction, float)
        if abs(along[2]) < 1e-6 or (height - start[2]) / along[2] < 0:
            return float("nan"), float("nan")
        x, y, _ = start + (height - start[2]) / along[2] * along
        return float(x), float(y)

    def point_camera(self, room: RoomShape) -> None:
        """Point the initial camera at the robot, or at the whole room if the robot is not followed."""
        x_min, x_max, y_min, y_max = room.bounds
        camera = self.server.initial_camera
        if self.follows:
            camera.position, camera.look_at = tuple(CAMERA_OFFSET), (0.0, 0.0, 0.10)
        else:
            size, centre = max(x_max - x_min, y_max - y_min), np.array([(x_min + x_max) / 2, (y_min + y_max) / 2, 0])
            camera.position, camera.look_at = tuple(centre + size * OVERVIEW), tuple(centre)

    def _draw_bounds(self, room: RoomShape) -> None:
        x_min, x_max, y_min, y_max = map(float, room.bounds)
        width, depth, height = x_max - x_min, y_max - y_min, float(room.wall_height)
        centre = ((x_min + x_max) / 2, (y_min + y_max) / 2)
        self.server.scene.add_box(
            f"{WORLD}/floor",
            color=FLOOR,
            dimensions=(width, depth, 0.02),
            position=(*centre, -0.0115),
            cast_shadow=False,
        )
        self.server.scene.add_grid(
            f"{WORLD}/floor/grid",
            width=width,
            height=depth,
            plane="xy",
            cell_size=0.25,
            section_size=1.0,
            cell_color=(214, 209, 199),
            section_color=(190, 184, 172),
            position=(0.0, 0.0, 0.0115),
        )
        sides = ((x_min, centre[1], 0.02, depth), (x_max, centre[1], 0.02, depth))
        ends = ((centre[0], y_min, width, 0.02), (centre[0], y_max, width, 0.02))
        for number, (x, y, dx, dy) in enumerate((*sides, *ends)):
            self.server.scene.add_box(
                f"{WORLD}/walls/{number}",
                color=WALL,
                dimensions=(dx, dy, height),
                opacity=0.35,
                position=(x, y, height / 2),
                cast_shadow=False,
            )

    def _draw_obstacle(self, room: RoomShape, index: int) -> None:
        bottom, top = float(room.bottom[index]), float(room.top[index])
        dx, dy = (2 * room.half_size[index]).tolist()
        if room.is_round[index]:
            mesh = trimesh.creation.cylinder(radius=dx / 2, height=top - bottom, sections=40)
        else:
            mesh = trimesh.creation.box(extents=(dx, dy, top - bottom))
        colour = OVERHEAD if bottom > 0 else CYLINDER if room.is_round[index] else BOX
        self._heights[index] = (bottom + top) / 2
        half = float(room.yaw[index]) / 2
        handle = self.server.scene.add_mesh_simple(
            f"{WORLD}/obstacles/{index}",
            vertices=mesh.vertices,
            faces=mesh.faces,
            color=colour,
            flat_shading=not room.is_round[index],
            wxyz=(np.cos(half), 0.0, 0.0, np.sin(half)),
            opacity=0.5 if bottom > 0 else None,
        )
        self._obstacles[index] = handle

    def enable_drag(self, on_move: Callable[[int, float, float], None]) -> None:
        """Call `on_move` with an obstacle's number and its new position [m] while the user drags it."""
        for index, handle in self._obstacles.items():

            @handle.on_drag("left")
            async def _(event: "viser.SceneNodeDragEvent", index: int = index) -> None:
                eye = event.client.camera.position
                grasp, pointer = np.asarray(event.start_position), np.asarray(event.end_position)
                before = np.asarray(event.start_position) - self._offset
                x, y = self.to_floor(tuple(eye), tuple(pointer - eye), float(grasp[2]))
                if np.isfinite([x, y]).all():
                    centre = self._centres[index] + [x - before[0], y - before[1]]
                    on_move(index, *map(float, centre))

    def _add_line(self, name: str, points: Float[ndarray, "n 3"], colour: tuple[int, int, int]) -> None:
        """Draw a line, on the floor if it is a path of the trunk."""
        path = np.array(points, float)
        if "/paths/" in name:
            path[:, 2] = LINE_HEIGHT
        segments = np.stack([path[:-1], path[1:]], axis=1)
        self.server.scene.add_line_segments(
            name, points=segments, colors=colour, thickness=2.0, thickness_units="screen"
        )
