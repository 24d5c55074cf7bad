"""A picture of the robot in its room, from behind: what `render_mode="rgb_array"` shows.

The same view as in videos of walks (`lgmdjax.reporting.walk_video`), for one moment.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from lgmdjax import geometry
from lgmdjax.environments.functional import Environment, State
from lgmdjax.reporting import robot_shape, third_person, walk_video
from lgmdjax.reporting.third_person import RobotCapsules, Viewpoint
from lgmdjax.simulation.closed_loop import FRAME_RATE
from lgmdjax.world import arena

VIEW = third_person.Params()


def render(environment: Environment, state: State) -> UInt8[np.ndarray, "height width 3"]:
    """Return the robot in its room from behind, as RGB of 8 bits; 320 x 200 pixels.

    Args:
        environment: of one robot or many.
        state: of one robot.
    """
    qpos = np.asarray(state.robot.data.qpos, float)
    body = robot_shape.body_geometry(qpos[None], environment.params.body)
    heading = geometry.yaw(qpos[3:7])
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    target = qpos[:3]
    position = target - walk_video.CAMERA_BEHIND * forward + np.array([0, 0, walk_video.CAMERA_ABOVE])
    rotation = walk_video.look_at(position[None], (target + walk_video.LOOK_AHEAD * forward)[None])[0]
    single = partial(jnp.asarray, dtype=jnp.float32)
    view = Viewpoint(single(position), single(rotation))
    robot = RobotCapsules(*map(single, (body.starts[0], body.ends[0], body.radii, body.colours)))
    room = jax.tree.map(lambda leaf: leaf[state.room].astype(jnp.float32), environment.rooms.arena)
    return np.asarray(_render_view(room, state.robot.frame / FRAME_RATE, view, robot, single(target)))


@jax.jit
def _render_view(
    room: arena.Arena, time: Float[Array, ""], view: Viewpoint, robot: RobotCapsules, target: Float[Array, "3"]
) -> UInt8[Array, "height width 3"]:
    scene = arena.at_time(room, time.astype(jnp.float32))
    return (255 * third_person.render_view(VIEW, scene, view, robot, target)).astype(jnp.uint8)
