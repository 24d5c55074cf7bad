"""The robot in a room, for C MuJoCo: its true geoms collide, with MuJoCo's default contacts, and it has cube cameras.

In `mjcf/hexapod.xml` the feet collide with the floor, and a few enlarged shapes collide with barriers, as MJX requires.
Here barriers and explicit pairs are left out. Every visible geom of the robot collides with floor, walls and obstacles,
in hard contacts with the friction of the geoms.
"""

import mujoco
import numpy as np

from lgmdjax.body import robot_xml
from lgmdjax.transfer import cube_camera
from lgmdjax.world import mujoco_world
from lgmdjax.world.arena import Arena
from lgmdjax.world.mujoco_world import PHOTOGRAPHIC, ROBOT, WORLD, Style

DRAWN = 2  # group of the robot's visible geoms in the XML


def build(
    room: Arena,
    style: Style = PHOTOGRAPHIC,
    *,
    seed: int = 0,
    face: int = cube_camera.FACE,
    body: robot_xml.Body | None = None,
) -> mujoco.MjModel:
    """Return the robot's model with a single room around it.

    Args:
        room: a single room, not a batch.
        style: appearance of the room.
        seed: seed of textures and shapes.
        face: width of a face of the cube cameras [px].
        body: of the robot; the package's if None.
    """
    spec = robot_xml.read_spec(body)
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in [geom for geom in spec.geoms if geom.name.startswith("before_")]:
        spec.delete(geom)
    for geom in spec.geoms:
        if geom.group == DRAWN:
            geom.contype, geom.conaffinity = ROBOT, WORLD
    cube_camera.add_cameras(spec, face)
    mujoco_world.add_room(spec, room, style, seed)
    return spec.compile()


def reset(model: mujoco.MjModel, data: mujoco.MjData, start: np.ndarray) -> None:
    """Put the robot at rest at a start pose x, y, yaw [m, m, rad], in its default stance."""
    x, y, yaw = (float(value) for value in start)
    stance = model.key("stance").qpos
    data.qpos[:] = stance
    data.qpos[:2], data.qpos[3:7] = (x, y), (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = 0.0, 0.0, stance[7:]
    mujoco.mj_forward(model, data)
