"""The robot's body: a MuJoCo model of a PhantomX AX Mark II class hexapod, and what reads and moves it.

`mjcf/hexapod.xml` is the home of every mass, length, limit and gain; this module turns its names into static
indices and reads poses out of `mjx.Data`. The `mjx.Model` is an argument everywhere, so that robots in rooms
of their own are a `vmap`: the physics has a plane for each shape that collides, which `place_obstacles` puts before
what is nearest. More would cost: in MJX every pair that may touch is computed in each step.

| symbol  | name                                              | unit               |
| ------- | ------------------------------------------------- | ------------------ |
| qpos    | trunk's position, its quaternion, 18 joint angles | m; 1 (w x y z); rad |
| targets | servo set points (6, 3): a row a leg, as in LEGS  | rad                |

World and trunk frames: x forward, y left, z up. The sources of the numbers stand in the XML.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax.core import Tracer
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from lgmdjax.body import implicit_step
from lgmdjax.errors import InputError
from lgmdjax.paths import MJCF
from lgmdjax.world import arena

LEGS = ("left_front", "left_middle", "left_rear", "right_rear", "right_middle", "right_front")
JOINTS = ("coxa", "femur", "tibia")
EYES = ("eye_left", "eye_right")
CAPSULES = ("bumper", *(f"{leg}_{part}" for leg in LEGS for part in JOINTS[1:]))  # what collides, in capsules' order
LOWEST, HIGHEST = 0.04, 0.30  # m; where the trunk of a robot on its feet can be
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
    capsules: np.ndarray  # (13,) geoms that collide with obstacles
    feet: np.ndarray  # (6,) geoms that stand on the floor
    barriers: np.ndarray  # (13,) planes, one for each of the capsules
    shapes: tuple[str, ...]  # names of all geoms


def xml_path() -> Path:
    """Find the robot's XML: inside the installed package, else beside it in the checkout."""
    for place in MJCF:
        if (place / "hexapod.xml").is_file():
            return place / "hexapod.xml"
    raise InputError(f"expected hexapod.xml in {' or '.join(map(str, MJCF))}, found none: reinstall lgmdjax")


def load(path: Path | str | None = None) -> mujoco.MjModel:
    """Load the robot, or a variant of it with the same names from a file of the user's, for C MuJoCo."""
    path = xml_path() if path is None else Path(path)
    if not path.is_file():
        raise InputError(f"expected a robot's XML file, {path} is none: give the path of a hexapod.xml")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"expected a MuJoCo model in {path}, it does not compile ({reason}): mend it") from None
    servos = [model.actuator(i).name for i in range(model.nu)]
    expected = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
    if servos != expected:
        raise InputError(
            f"expected {len(expected)} servos {expected[0]} ... {expected[-1]} in {path}, got {len(servos)}"
            f" ({', '.join(servos[:3])} ...): start from the hexapod.xml of this package"
        )
    return model


def build(model: mujoco.MjModel | None = None) -> mjx.Model:
    """Put the robot (default: `load()`) on the device for MJX, in the precision that JAX is set to.

    Raises InputError for a variant whose shapes are not those of the package's XML, or in another order.
    """
    model = load() if model is None else model
    for expected, found in zip(_anatomy().shapes, _shapes(model), strict=False):
        if found != expected:
            raise InputError(
                f"expected the geoms of this package's hexapod.xml in its order, got {found or 'one without a name'} "
                f"for {expected}: start from that file, and add others at its end"
            )
    with jax.numpy_dtype_promotion("standard"):
        return _free(mjx.put_model(model, impl="jax"))


def softened(model: mjx.Model) -> mjx.Model:
    """Soften the contacts (solref 0.06, solimp 0.2 0.9 0.02), so that a derivative says more about larger steps.

    With the contacts of the XML, differences over 3e-2 rad are a quarter off the derivative; with these all scales
    agree within 2 %.
    """
    solref = jnp.zeros_like(model.pair_solref) + jnp.array([0.06, 1.0], model.pair_solref.dtype)
    solimp = model.pair_solimp.at[:, :3].set(jnp.array([0.2, 0.9, 0.02], model.pair_solimp.dtype))
    return model.replace(pair_solref=solref, pair_solimp=solimp)


@cache
def _anatomy() -> _Anatomy:
    model = load()

    def geoms(names: list[str]) -> np.ndarray:
        # Of 32 bits in either precision: JAX remembers of an array of 64 the precision in which it met it first.
        return np.array([model.geom(name).id for name in names], dtype=np.int32)

    return _Anatomy(
        stance=model.key("stance").qpos.copy(),
        eyes=np.stack([model.site(name).pos for name in EYES]),
        laser=model.site("laser").pos.copy(),
        capsules=geoms([*CAPSULES]),
        feet=geoms([f"{leg}_foot" for leg in LEGS]),
        barriers=geoms([f"before_{name}" for name in CAPSULES]),
        shapes=_shapes(model),
    )


def _shapes(model: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(model.geom(index).name for index in range(model.ngeom))


def _free(tree: Any) -> Any:
    """Untie arrays from the device that MJX put them on.

    Tied ones would not be sharded with others, and `jit` compiles anew for each mixture of tied and free arguments.
    """
    return jax.tree.map(lambda leaf: leaf if isinstance(leaf, Tracer) else jnp.array(np.asarray(leaf)), tree)


def stance() -> Float[np.ndarray, "6 3"]:
    """Return the joint angles [rad] of the default stance (the XML's key frame)."""
    return _anatomy().stance[7:].reshape(6, 3)


def reset(model: mjx.Model, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None) -> mjx.Data:
    """Stand a robot still on the floor at (x, y, yaw) [m, m, rad], by default in the key frame's stance."""
    # put_data's contact indices are narrower than a step's under x64, and a loop's carry must keep its types.
    with jax.numpy_dtype_promotion("standard"):  # MJX multiplies truth values by floats
        data = _free(mjx.make_data(model))
    return put(data, start, angles)


def put(data: mjx.Data, start: Float[Array, "3"], angles: Float[Array, "6 3"] | None = None) -> mjx.Data:
    """Lift a robot and put it down again, still, at (x, y, yaw) [m, m, rad]; angles as in `reset`."""
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
    """Advance the physics by the XML's time step (1/180 s) with the servos' set points at `targets` [rad].

    Set points beyond the joint limits are clipped.

    Gradient: by either mode, of the solver's solution (`lgmdjax.body.implicit_step`); zero for a target that is
    clipped and for a servo at its torque limit.
    """
    with jax.numpy_dtype_promotion("standard"):  # MJX multiplies truth values by floats
        return implicit_step.step(model, data.replace(ctrl=targets.reshape(18).astype(data.ctrl.dtype)))


def place_obstacles(model: mjx.Model, room: arena.Arena, data: mjx.Data) -> mjx.Model:
    """Put a barrier between each shape that collides and what is nearest to it where the robot stands.

    A barrier is an upright plane that touches the nearest obstacle or wall (`arena.tangents`): it is as far off as
    that. It is meant for a frame: planes have no end, and a foot in swing, which moves by a centimetre or two until
    the next, may meet air beyond the edge of a thing. Of two things that a shape would touch at once, as the walls of
    a corner, it knows the nearer one only. What counts as a touch is measured apart (`arena.clearance`).

    Gradient: by the room and by the pose, through where and how the planes stand; which thing is nearest has none.
    """
    with jax.numpy_dtype_promotion("standard"):
        starts, ends, _ = capsules(model, mjx.kinematics(model, data))
    normals, offsets = arena.tangents(room, starts, ends)
    x, y = normals.T
    zero = jnp.zeros_like(x)
    # The quarter turn about (-y, x, 0) that takes a plane's own normal, z, to (x, y, 0).
    turn = jnp.sqrt(0.5) * jnp.stack([zero + 1, -y, x, zero], axis=1)
    position = jnp.stack([offsets * x, offsets * y, zero], axis=1)
    ids = _anatomy().barriers
    return model.replace(
        geom_pos=model.geom_pos.at[ids].set(position.astype(model.geom_pos.dtype)),
        geom_quat=model.geom_quat.at[ids].set(turn.astype(model.geom_quat.dtype)),
    )


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
    """Return the heading [rad] in (-pi, pi], positive to the left.

    Gradient: undefined with the nose straight up.
    """
    forward = rotation(pose)[:, 0]
    return jnp.arctan2(forward[1], forward[0])


def swaying(pose: Pose, factor: Float[Array, ""]) -> Pose:
    """Multiply the angle by which a pose is tilted, its heading kept: 0 is level. Not differentiable when level."""
    w, x, y, z = pose.quaternion
    length = jnp.hypot(w, z)
    c, s = w / length, z / length  # of half the heading: the pose is a tilt about a level axis, then the heading
    a, b = c * x + s * y, c * y - s * x
    size = jnp.hypot(a, b)
    half = factor * jnp.arctan2(size, length)
    grown = jnp.where(size > 0, jnp.sin(half) / jnp.where(size > 0, size, 1.0), 0.0)
    a, b = grown * a, grown * b
    quaternion = jnp.stack([c * jnp.cos(half), c * a - s * b, c * b + s * a, s * jnp.cos(half)])
    return Pose(position=pose.position, quaternion=quaternion)


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
    """Read the capsules of trunk and legs that collide, as they were at the start of the last substep.

    Returns:
        Both ends (13, 3) [m, world] and radii (13,) [m]: the trunk's, then femur and tibia of each leg.
    """
    ids = _anatomy().capsules
    along = data.geom_xmat[ids].reshape(-1, 3, 3)[..., 2] * model.geom_size[ids, 1, None]
    return data.geom_xpos[ids] - along, data.geom_xpos[ids] + along, model.geom_size[ids, 0]


def is_sound(data: mjx.Data) -> Bool[Array, ""]:
    """Tell whether the state is finite and the robot on its feet: not fallen, on its belly or in the air."""
    finite = jnp.all(jnp.isfinite(data.qpos)) & jnp.all(jnp.isfinite(data.qvel))
    upright = rotation(pose(data))[2, 2] > LEAST_UPRIGHT
    height = data.qpos[2]
    return finite & upright & (height > LOWEST) & (height < HIGHEST)
