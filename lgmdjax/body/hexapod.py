"""The robot's body: the MuJoCo model of a hexapod of the PhantomX AX Mark II class, its sensors' poses and its physics.

`mjcf/hexapod.xml` defines every mass, length, limit and gain, with its source. This module finds indices by the names
in that file, which are static in a model, and reads poses from `mjx.Data`. A body of one's own
(`lgmdjax.body.custom_robot`) has the same names.

The `mjx.Model` is an argument everywhere, so that `vmap` gives each robot its own room. The obstacles of a room are not
part of the model. Instead it has one plane, a barrier, for each geom that collides with obstacles, and `place_barriers`
puts it at the nearest obstacle. This keeps the physics fast, since MJX evaluates in each step every pair of geoms that
may collide.

| symbol  | name                                                  | unit                |
| ------- | ----------------------------------------------------- | ------------------- |
| qpos    | position and quaternion of the trunk, 18 joint angles | m; 1 (w x y z); rad |
| targets | servo set points (6, 3), one row per leg as in LEGS   | rad                 |

World and trunk frames: x forward, y left, z up.
"""

from collections.abc import Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from lgmdjax.body import implicit_step
from lgmdjax.body.robot_xml import CAPSULES as CAPSULES
from lgmdjax.body.robot_xml import EYES as EYES
from lgmdjax.body.robot_xml import JOINTS as JOINTS
from lgmdjax.body.robot_xml import LEGS as LEGS
from lgmdjax.body.robot_xml import Body as Body
from lgmdjax.body.robot_xml import Offset, sensor_mounts
from lgmdjax.body.robot_xml import load as load
from lgmdjax.body.robot_xml import stance as stance
from lgmdjax.body.robot_xml import target_limits as target_limits
from lgmdjax.body.robot_xml import xml_path as xml_path
from lgmdjax.errors import InputError
from lgmdjax.geometry import rotation_matrix
from lgmdjax.runtime.mjx import mjx
from lgmdjax.world import arena

Tree = TypeVar("Tree")

BARRIERS = tuple(f"before_{name}" for name in CAPSULES)  # planes, one for each capsule
FEET = tuple(f"{leg}_foot" for leg in LEGS)  # spheres that stand on the floor
MIN_TRUNK_HEIGHT, MAX_TRUNK_HEIGHT = 0.366, 2.74  # of the height in the stance: 4 to 30 cm for the package's robot
MIN_UPRIGHT = 0.7  # cosine of the trunk's tilt; below it (45 degrees) the robot has fallen


@struct.dataclass(kw_only=True)
class Pose:
    """Position and orientation of the trunk, from which the poses of eyes and laser follow."""

    position: Float[Array, "3"]  # m, world
    quaternion: Float[Array, "4"]  # w x y z


def build(model: mujoco.MjModel | None = None) -> mjx.Model:
    """Convert the robot (default: `load()`) to an MJX model, in JAX's current default precision.

    Raises InputError for a variant that lacks one of the names that this module uses.
    """
    model = load() if model is None else model
    kinds = {"geom": (*CAPSULES, *BARRIERS, *FEET), "site": (*EYES, "laser"), "key": ("stance",)}
    for kind, names in kinds.items():
        ids = {getattr(model, kind)(index).name for index in range(getattr(model, f"n{kind}"))}
        if missing := [name for name in names if name not in ids]:
            raise InputError(
                f"expected a {kind} {missing[0]}, as in this package's hexapod.xml, got none; start from that file, or "
                "describe the robot in a TOML file (docs/howto/robot.md)"
            )
    with jax.numpy_dtype_promotion("standard"):
        # MJX's own choice is the first device of all processes, which in most processes is not theirs.
        return _uncommit(mjx.put_model(model, device=jax.local_devices()[0], impl="jax"))


def soften_contacts(model: mjx.Model) -> mjx.Model:
    """Return the model with soft contacts, whose derivative is valid over larger steps.

    Soft contacts have solref 0.06 and solimp 0.2 0.9 0.02. With the contacts of the XML, differences over 3e-2 rad
    deviate from the derivative by a quarter; with soft contacts, differences of all sizes agree within 2 %.
    """
    solref = jnp.zeros_like(model.pair_solref) + jnp.array([0.06, 1.0], model.pair_solref.dtype)
    solimp = model.pair_solimp.at[:, :3].set(jnp.array([0.2, 0.9, 0.02], model.pair_solimp.dtype))
    return model.replace(pair_solref=solref, pair_solimp=solimp)


def _geom_ids(model: mjx.Model, names: Sequence[str]) -> np.ndarray:
    # 32 bits in both precisions: JAX caches a 64-bit array in the precision of its first use.
    return np.array([mjx.name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in names], dtype=np.int32)


def _stance(model: mjx.Model) -> Float[np.ndarray, "25"]:
    """Return the coordinates (qpos) of the default stance, which are static in a model."""
    return model.key_qpos[mjx.name2id(model, mujoco.mjtObj.mjOBJ_KEY, "stance")]


def _uncommit(tree: Tree) -> Tree:
    """Return a pytree of arrays that are not committed to the device on which MJX put them.

    Committed arrays would not be sharded with others, and `jit` would compile again for each combination of committed
    and uncommitted arguments.
    """
    return jax.tree.map(lambda leaf: leaf if isinstance(leaf, Tracer) else jnp.array(np.asarray(leaf)), tree)


def init(model: mjx.Model, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None) -> mjx.Data:
    """Create the state of a robot that stands at rest on the floor.

    Args:
        model: from `build`.
        start: x, y, yaw [m, m, rad].
        angles: joint angles [rad]; the default stance if None.
    """
    # Not `put_data`: under x64 its contact indices are narrower than those of a step, and the carry of a loop must keep
    # its types.
    with jax.numpy_dtype_promotion("standard"):  # MJX multiplies booleans by floats
        data = _uncommit(mjx.make_data(model, device=jax.local_devices()[0]))
    return reset(model, data, start, angles)


def reset(
    model: mjx.Model, data: mjx.Data, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None
) -> mjx.Data:
    """Return the state of the same robot at rest at a new start pose; arguments as in `init`."""
    stance = jnp.asarray(_stance(model), data.qpos.dtype)
    joints = stance[7:] if angles is None else angles.reshape(18).astype(stance.dtype)
    x, y, yaw = start.astype(stance.dtype)
    zero = jnp.zeros_like(yaw)
    trunk = jnp.stack([x, y, stance[2], jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])
    return data.replace(
        qpos=jnp.concatenate([trunk, joints]),
        qvel=jnp.zeros_like(data.qvel),
        qacc_warmstart=jnp.zeros_like(data.qacc_warmstart),
        ctrl=joints,
        time=jnp.zeros_like(data.time),
    )


def substep(model: mjx.Model, data: mjx.Data, targets: Float[Array, "6 3"]) -> mjx.Data:
    """Advance the physics by the time step of the XML (1/180 s) with the servos' set points at `targets` [rad].

    Set points beyond the joint limits are clipped.

    Gradient: that of the solver's solution, in both modes (`lgmdjax.body.implicit_step`). It is zero for a target that
    is clipped and for a servo at its torque limit.
    """
    with jax.numpy_dtype_promotion("standard"):  # MJX multiplies booleans by floats
        return implicit_step.step(model, data.replace(ctrl=targets.reshape(18).astype(data.ctrl.dtype)))


def place_barriers(model: mjx.Model, room: arena.Arena, data: mjx.Data) -> mjx.Model:
    """Place a barrier between each geom that collides and the obstacle nearest to it.

    A barrier is an upright plane that touches the nearest obstacle or wall (`arena.separating_lines`), at the same
    distance from the geom. It is valid for one camera frame. Planes are infinite, and a foot in swing, which moves by
    one or two centimetres in a frame, may hit a plane beyond the edge of its obstacle. If a geom touches two obstacles
    at once, as two walls in a corner, only the nearer one has a barrier. Contacts are detected separately
    (`arena.clearance`).

    Gradient: with respect to room and pose, through position and orientation of the planes; none through the choice of
    the nearest obstacle.
    """
    with jax.numpy_dtype_promotion("standard"):
        starts, ends, _ = capsules(model, mjx.kinematics(model, data))
    normals, offsets = arena.separating_lines(room, starts, ends)
    x, y = normals.T
    zero = jnp.zeros_like(x)
    # The rotation by 90 degrees about (-y, x, 0), which rotates the normal of a plane from z to (x, y, 0).
    quaternion = jnp.sqrt(0.5) * jnp.stack([zero + 1, -y, x, zero], axis=1)
    position = jnp.stack([offsets * x, offsets * y, zero], axis=1)
    ids = _geom_ids(model, BARRIERS)
    return model.replace(
        geom_pos=model.geom_pos.at[ids].set(position.astype(model.geom_pos.dtype)),
        geom_quat=model.geom_quat.at[ids].set(quaternion.astype(model.geom_quat.dtype)),
    )


def pose(data: mjx.Data) -> Pose:
    """Return the trunk's position [m] and quaternion."""
    return Pose(position=data.qpos[:3], quaternion=data.qpos[3:7])


def rotation(pose: Pose) -> Float[Array, "3 3"]:
    """Return the matrix that rotates the trunk frame into the world frame.

    >>> rotation(Pose(position=jnp.zeros(3), quaternion=jnp.array([1.0, 0.0, 0.0, 0.0]))).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return jnp.asarray(rotation_matrix(pose.quaternion))


def yaw(pose: Pose) -> Float[Array, ""]:
    """Return the heading [rad] in (-pi, pi], positive to the left.

    Gradient: undefined where the trunk points straight up or down.
    """
    forward = rotation(pose)[:, 0]
    return jnp.arctan2(forward[1], forward[0])


def scale_tilt(pose: Pose, factor: Float[Array, ""]) -> Pose:
    """Multiply the tilt angle of a pose by `factor` and keep its heading; 0 gives a level pose.

    Gradient: undefined at a level pose.
    """
    w, x, y, z = pose.quaternion
    length = jnp.hypot(w, z)
    # Cosine and sine of half the heading: a pose is a tilt about a level axis, then a rotation by the heading.
    c, s = w / length, z / length
    a, b = c * x + s * y, c * y - s * x
    sine = jnp.hypot(a, b)
    half = factor * jnp.arctan2(sine, length)
    ratio = jnp.where(sine > 0, jnp.sin(half) / jnp.where(sine > 0, sine, 1.0), 0.0)
    a, b = ratio * a, ratio * b
    quaternion = jnp.stack([c * jnp.cos(half), c * a - s * b, c * b + s * a, s * jnp.cos(half)])
    return Pose(position=pose.position, quaternion=quaternion)


def eye_poses(
    pose: Pose, mounts: tuple[Offset, Offset] | None = None
) -> tuple[Float[Array, "2 3"], Float[Array, "2 3 3"]]:
    """Return positions [m] and rotation matrices of the left and the right eye (x forward, y left, z up).

    Args:
        pose: of the trunk.
        mounts: where the eyes sit in the trunk's frame [m]; where those of the package's robot do if None.
    """
    matrix = rotation(pose)
    offsets = jnp.asarray(sensor_mounts().eyes if mounts is None else mounts, matrix.dtype)
    return pose.position + offsets @ matrix.T, jnp.broadcast_to(matrix, (2, 3, 3))


def laser_pose(pose: Pose, mount: Offset | None = None) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return position [m] and rotation matrix of the laser scanner; arguments as those of `eye_poses`."""
    matrix = rotation(pose)
    return pose.position + matrix @ jnp.asarray(mount or sensor_mounts().laser, matrix.dtype), matrix


def joint_angles(data: mjx.Data) -> Float[Array, "6 3"]:
    """Return the joint angles [rad], one row per leg as in `LEGS`."""
    return data.qpos[7:].reshape(6, 3)


def foot_positions(model: mjx.Model, data: mjx.Data) -> Float[Array, "6 3"]:
    """Return the centres of the feet [m, world], at the start of the last substep."""
    return data.geom_xpos[_geom_ids(model, FEET)]


def capsules(
    model: mjx.Model, data: mjx.Data
) -> tuple[Float[Array, "capsules 3"], Float[Array, "capsules 3"], Float[Array, " capsules"]]:
    """Return the capsules of trunk and legs that collide with obstacles, at the start of the last substep.

    Returns:
        Both ends (13, 3) [m, world] and radii (13,) [m], in the order of `CAPSULES`.
    """
    ids = _geom_ids(model, CAPSULES)
    along = data.geom_xmat[ids].reshape(-1, 3, 3)[..., 2] * model.geom_size[ids, 1, None]
    return data.geom_xpos[ids] - along, data.geom_xpos[ids] + along, model.geom_size[ids, 0]


def is_healthy(model: mjx.Model, data: mjx.Data) -> Bool[Array, ""]:
    """Return whether the state is finite and the robot is on its feet: not fallen over, on its belly or in the air."""
    is_finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
    is_upright = rotation(pose(data))[2, 2] > MIN_UPRIGHT
    height, standing = data.qpos[2], float(_stance(model)[2])
    is_up = (height > MIN_TRUNK_HEIGHT * standing) & (height < MAX_TRUNK_HEIGHT * standing)
    return is_finite & is_upright & is_up
