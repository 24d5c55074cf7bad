"""The robot's body: a MuJoCo model of a PhantomX AX Mark II class hexapod, its readers, and obstacles to bump into.

`mjcf/hexapod.xml` is the home of every mass, length, limit and gain; this module turns its names into static indices
and reads poses out of `mjx.Data`. The `mjx.Model` is an argument everywhere, so that robots in rooms of their own are
a `vmap`: the physics knows a few obstacle slots, which `place_obstacles` moves to the obstacles nearest to a robot.

    symbol      name                              unit
    qpos        trunk position, quaternion        m, 1 (w x y z)
                and 18 joint angles               rad
    targets     servo set points (6, 3)           rad; legs left front ... right front, joints coxa, femur, tibia

World and body frames: x forward, y left, z up. Source of the numbers: the Mark II's firmware, the Mark IV's CAD masses,
the AX-12A's manual and the paper (sec. 3.1), as noted in the XML.
"""

from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from lgmdjax import arena
from lgmdjax.errors import InputError

LEGS = ("left_front", "left_middle", "left_rear", "right_rear", "right_middle", "right_front")
JOINTS = ("coxa", "femur", "tibia")
EYES = ("eye_left", "eye_right")
LOWEST_TRUNK = 0.04  # m; below it the belly lies on the floor
LEAST_UPRIGHT = 0.7  # cosine of the trunk's tilt; below it (45 degrees) the robot has fallen


@struct.dataclass(kw_only=True)
class Pose:
    """Where the trunk is: enough to draw what the eyes see and what the laser measures."""

    position: Float[Array, "3"]  # m, world
    quaternion: Float[Array, "4"]  # w x y z


class _Anatomy(NamedTuple):
    """Indices and offsets that the XML fixes, read once."""

    stance: np.ndarray  # (25,) qpos of the default stance
    eyes: np.ndarray  # (2, 3) m, in the trunk's frame
    laser: np.ndarray  # (3,) m, in the trunk's frame
    capsules: np.ndarray  # geoms that collide with obstacles
    feet: np.ndarray  # (6,) geoms that stand on the floor
    boxes: np.ndarray  # obstacle slots
    cylinders: np.ndarray


def xml_path() -> Path:
    """Find the robot's XML: inside the installed package, else beside it in the checkout."""
    places = [Path(str(files("lgmdjax"))) / "mjcf", Path(__file__).resolve().parent.parent / "mjcf"]
    for place in places:
        if (place / "hexapod.xml").is_file():
            return place / "hexapod.xml"
    raise InputError(f"expected the robot's hexapod.xml in {' or '.join(map(str, places))}, found none: reinstall lgmdjax")


def load(path: Path | str | None = None) -> mujoco.MjModel:
    """Load the robot, or a variant of it from a file of the same names, for C MuJoCo."""
    path = Path(path) if path is not None else xml_path()
    if not path.is_file():
        raise InputError(f"expected a robot XML file, {path} is none: give the path of a hexapod.xml")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(f"expected a MuJoCo model in {path}, it does not compile: {error}") from None


def build(model: mujoco.MjModel | None = None) -> mjx.Model:
    """Put the robot (default: `load()`) on the device for MJX."""
    with jax.numpy_dtype_promotion("standard"):
        return mjx.put_model(model if model is not None else load(), impl="jax")


def differentiable(model: mjx.Model, *, soft: bool = False) -> mjx.Model:
    """Make the solver one that reverse mode passes through: one Newton iteration, four of line search.

    `soft=True` also softens the contacts (solref 0.06, solimp 0.2 0.9 0.02), which smooths the landscape over larger
    steps. Gradient: exact for the single iteration taken.
    """
    model = model.replace(opt=model.opt.replace(iterations=1, ls_iterations=4))
    if not soft:
        return model
    solref = jnp.zeros_like(model.pair_solref) + jnp.array([0.06, 1.0], model.pair_solref.dtype)
    solimp = model.pair_solimp.at[:, :3].set(jnp.array([0.2, 0.9, 0.02], model.pair_solimp.dtype))
    return model.replace(pair_solref=solref, pair_solimp=solimp)


@cache
def _anatomy() -> _Anatomy:
    model = load()
    trunk_sites = {model.site(i).name: model.site(i).pos for i in range(model.nsite)}
    names = [model.geom(i).name for i in range(model.ngeom)]

    def geoms(prefix: str) -> np.ndarray:
        return np.array([i for i, name in enumerate(names) if name.startswith(prefix)])

    return _Anatomy(
        stance=model.key("stance").qpos.copy(),
        eyes=np.stack([trunk_sites[name] for name in EYES]),
        laser=np.array(trunk_sites["laser"]),
        capsules=geoms("hit_"),
        feet=np.array([model.geom(f"{leg}_foot").id for leg in LEGS]),
        boxes=geoms("slot_box_"),
        cylinders=geoms("slot_cylinder_"),
    )


def stance() -> Float[np.ndarray, "6 3"]:
    """Return the joint angles [rad] of the default stance (the XML's key frame)."""
    return _anatomy().stance[7:].reshape(6, 3)


def reset(model: mjx.Model, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None) -> mjx.Data:
    """Stand a robot still on the floor at (x, y, yaw) [m, m, rad], in the default stance or with given joint angles."""
    # Not put_data: its contact indices are narrower than those a step returns under x64, and a loop's carry keeps its types.
    with jax.numpy_dtype_promotion("standard"):  # MJX itself multiplies truth values by floats
        data = mjx.make_data(model)
    return put(data, start, angles)


def put(data: mjx.Data, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None) -> mjx.Data:
    """Lift a robot and put it down at (x, y, yaw), still, in the default stance or with given joint angles."""
    stance = jnp.asarray(_anatomy().stance, data.qpos.dtype)
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
    """Advance the physics by one time step of the XML (1/180 s) with the servos set to the joint targets [rad].

    Targets outside the joint limits are clipped by the servos. Gradient: through reverse mode only with
    `differentiable(model)`; zero for clipped targets and for servos at their torque limit.
    """
    with jax.numpy_dtype_promotion("standard"):  # MJX itself multiplies truth values by floats
        return mjx.step(model, data.replace(ctrl=targets.reshape(18).astype(data.ctrl.dtype)))


def place_obstacles(model: mjx.Model, room: arena.Arena, pose: Pose) -> mjx.Model:
    """Move the obstacle slots of the physics to the walls, boxes and cylinders nearest to the robot.

    A cylinder stands as a capsule whose caps reach beyond the cylinder's ends, into the floor and over the robot.
    """
    slots = _anatomy()
    boxes, cylinders = arena.nearest(room, pose.position[:2], len(slots.boxes), len(slots.cylinders))
    position, size, quaternion = model.geom_pos, model.geom_size, model.geom_quat
    for ids, prisms in ((slots.boxes, boxes), (slots.cylinders, cylinders)):
        middle, half_height = (prisms.top + prisms.bottom) / 2, (prisms.top - prisms.bottom) / 2
        turn = jnp.stack([jnp.cos(prisms.yaw / 2), 0 * prisms.yaw, 0 * prisms.yaw, jnp.sin(prisms.yaw / 2)], axis=-1)
        position = position.at[ids].set(jnp.concatenate([prisms.centre, middle[:, None]], axis=-1))
        quaternion = quaternion.at[ids].set(turn)
        if ids is slots.boxes:
            size = size.at[ids].set(jnp.concatenate([prisms.half_size, half_height[:, None]], axis=-1))
        else:
            size = size.at[ids, 0].set(prisms.half_size[:, 0]).at[ids, 1].set(half_height)
    return model.replace(geom_pos=position, geom_size=size, geom_quat=quaternion)


def pose(data: mjx.Data) -> Pose:
    """Read the trunk's position [m] and quaternion."""
    return Pose(position=data.qpos[:3], quaternion=data.qpos[3:7])


def rotation(pose: Pose) -> Float[Array, "3 3"]:
    """Return the matrix that turns the trunk's frame into the world's."""
    w, x, y, z = pose.quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def yaw(pose: Pose) -> Float[Array, ""]:
    """Return the heading [rad] in (-pi, pi]; positive is to the left. Gradient: undefined with the nose straight up."""
    forward = rotation(pose)[:, 0]
    return jnp.arctan2(forward[1], forward[0])


def eye_poses(pose: Pose) -> tuple[Float[Array, "2 3"], Float[Array, "2 3 3"]]:
    """Return where the left and the right eye are [m] and how they are turned (x forward, y left, z up)."""
    turned = rotation(pose)
    offsets = jnp.asarray(_anatomy().eyes, turned.dtype)
    return pose.position + offsets @ turned.T, jnp.broadcast_to(turned, (2, 3, 3))


def laser_pose(pose: Pose) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return where the laser scanner is [m] and how it is turned."""
    turned = rotation(pose)
    return pose.position + turned @ jnp.asarray(_anatomy().laser, turned.dtype), turned


def joints(data: mjx.Data) -> Float[Array, "6 3"]:
    """Read the joint angles [rad]."""
    return data.qpos[7:].reshape(6, 3)


def feet(data: mjx.Data) -> Float[Array, "6 3"]:
    """Read the centres of the feet [m] in the world, as they were at the start of the last substep."""
    return data.geom_xpos[_anatomy().feet]


def capsules(
    model: mjx.Model, data: mjx.Data
) -> tuple[Float[Array, "shapes 3"], Float[Array, "shapes 3"], Float[Array, " shapes"]]:
    """Return ends [m] and radii [m] of the capsules with which trunk and legs collide, at the start of the last substep."""
    ids = _anatomy().capsules
    reach = data.geom_xmat[ids].reshape(-1, 3, 3)[..., 2] * model.geom_size[ids, 1, None]
    return data.geom_xpos[ids] - reach, data.geom_xpos[ids] + reach, model.geom_size[ids, 0]


def is_sound(data: mjx.Data) -> Bool[Array, ""]:
    """Tell whether the state is finite and the robot on its feet, neither fallen over nor lying on its belly."""
    finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
    upright = rotation(pose(data))[2, 2] > LEAST_UPRIGHT
    return finite & upright & (data.qpos[2] > LOWEST_TRUNK)
