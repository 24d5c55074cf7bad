"""The nervous system of a trained robot: one stereo picture and a state in; set points of 18 servos and a state out.

`step` is one camera frame of the closed loop without its body, composed of the same functions of
`lgmdjax.control.controller`: both LGMDs and the navigator once, then CPG and shaping `SUBSTEPS` times. The other
modules of this wing export this function in other formats.

| symbol | name                   | unit                 | shape         | equation       |
| ------ | ---------------------- | -------------------- | ------------- | -------------- |
| L      | pictures               | grey, 0..255         | (2, rows, px) | 7              |
| u      | output.u               | 1, 0.5..1            | (2,)          | 14, 16         |
| v      | output.velocity        | nominal, 0.05 m/s    | (2,)          | 17             |
| -      | output.targets         | rad                  | (6, 6, 3)     | sec. 3.2       |

The pictures are whole; `step` crops them to the hemifield of each eye. Axes of the targets: substep, leg, joint.
The first row is for now, each further row for 1 / (`FRAME_RATE` `SUBSTEPS`) s later. As in `hexapod.substep`, targets
are clipped to the servos' limits.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from lgmdjax.body import hexapod
from lgmdjax.control import controller, navigator, policies
from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.locomotion import cpg
from lgmdjax.minmax import clip
from lgmdjax.sensors import camera, hemifield
from lgmdjax.simulation import closed_loop
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

POLICY = policies.LEARNED
Arrays = dict[str, Array]


@struct.dataclass(kw_only=True)
class Params:
    """Parameters of controller and servos, in single precision, and the size of the pictures."""

    controller: controller.Params  # with the navigator alone as its policy
    limits: Float[Array, "2 6 3"]  # rad, lowest and highest set points
    camera: camera.Params


@struct.dataclass(kw_only=True)
class State:
    """What the nervous system carries from one picture to the next."""

    lgmd: lgmd.State  # of both eyes, stacked
    navigator: navigator.State
    cpg: cpg.State
    is_first: Bool[Array, ""]  # no picture came yet, so that there is no change


@struct.dataclass(kw_only=True)
class Output:
    """The commands of one camera frame."""

    targets: Float[Array, "substeps 6 3"]  # rad
    u: Float[Array, "2"]
    velocity: Float[Array, "2"]


def from_robot(robot: closed_loop.Params) -> Params:
    """Return the nervous system of a robot with all five policies, as `assembly.load_robot` returns it.

    Raises InputError for a robot with another detector than the LGMD, and for one that does not see in every frame
    (`frame_stride`), as in one study.
    """
    controller.require_lgmd(robot.controller, "the export of its nervous system")
    if robot.frame_stride is not None:
        raise InputError(f"expected a robot that sees in every frame, got stride {robot.frame_stride}; set it to None")
    learned = robot.controller.policy.policies[policies.POLICIES.index(POLICY)]
    params = Params(
        controller=replace(robot.controller, policy=learned),
        limits=jnp.asarray(hexapod.target_limits(robot.body)),
        camera=robot.camera,
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), params)


def picture_shape(params: Params) -> tuple[int, int, int]:
    """Return the shape of a stereo picture: eyes, rows, columns; left eye first."""
    return 2, params.camera.height, params.camera.width


def cell_shape(params: Params) -> tuple[int, int]:
    """Return the numbers of rows and columns of an LGMD's cells."""
    return jax.eval_shape(lambda: init(params)).lgmd.frame.shape[1:]


def init(params: Params) -> State:
    """Return the state before the first picture: empty memory, and the CPG on its limit cycle."""
    black = jnp.zeros(camera.image_shape(params.camera), params.limits.dtype)
    state = controller.init(params.controller, black, POLICY, jax.random.key(0))
    return _without_command(state, jnp.asarray(True))


def step(params: Params, state: State, pictures: UInt8[Array, "2 height width"]) -> tuple[State, Output]:
    """Process a stereo picture: detect, decide, and move for `SUBSTEPS` substeps."""
    frames = crop(params, pictures)
    before = controller.State(
        detector=state.lgmd, policy=state.navigator, cpg=state.cpg, velocity=state.navigator.velocity
    )
    seen, response = controller.detect_or_start(params.controller, before, frames, state.is_first)
    decided = controller.decide(params.controller, seen, controller.observe_without_laser(response), POLICY)
    moved, targets = move(params, decided)
    output = Output(targets=targets, u=response.u, velocity=decided.velocity)
    return _without_command(moved, jnp.zeros_like(state.is_first)), output


def crop(params: Params, pictures: Array) -> Array:
    """Return the hemifields of both eyes, (2, rows, columns)."""
    field = {"overlap": params.camera.overlap, "ground": params.camera.ground}
    return jnp.stack([hemifield.crop(pictures[side], side, **field) for side in (hemifield.LEFT, hemifield.RIGHT)])


def move(params: Params, state: controller.State) -> tuple[controller.State, Float[Array, "substeps 6 3"]]:
    """Run CPG and shaping until the next picture; return the set points of each substep."""

    def substep(state: controller.State, _: None) -> tuple[controller.State, Float[Array, "6 3"]]:
        state, targets = controller.move(params.controller, state, 1 / (FRAME_RATE * SUBSTEPS))
        return state, clip(targets, *params.limits)

    return jax.lax.scan(substep, state, length=SUBSTEPS)


def by_name(params: Params) -> Callable[[Array, Arrays], tuple[Arrays, Arrays]]:
    """Return `step` as a function of a picture and a state; states and the output are dictionaries of arrays."""
    first = jax.eval_shape(lambda: init(params))
    names, structure = leaf_names(first), jax.tree.structure(first)

    def function(pictures: Array, state: Arrays) -> tuple[Arrays, Arrays]:
        after, output = step(params, jax.tree.unflatten(structure, [state[name] for name in names]), pictures)
        return dict(vars(output)), to_arrays(after)

    return function


def argument_types(params: Params) -> tuple[jax.ShapeDtypeStruct, dict[str, jax.ShapeDtypeStruct]]:
    """Return shapes and types of the arguments of `by_name`."""
    pictures = jax.ShapeDtypeStruct(picture_shape(params), jnp.uint8)
    return pictures, jax.eval_shape(lambda: to_arrays(init(params)))


def to_arrays(state: State) -> Arrays:
    """Return the arrays of a state by name."""
    return dict(zip(leaf_names(state), jax.tree.leaves(state), strict=True))


def leaf_names(state: PyTree) -> list[str]:
    """Return the name of each array of a state: its path.

    >>> leaf_names(navigator.init(navigator.create(jax.random.key(0))))
    ['hidden', 'cell', 'velocity']
    """
    return ["_".join(str(key.name) for key in path) for path, _ in jax.tree_util.tree_leaves_with_path(state)]


def _without_command(state: controller.State, is_first: Bool[Array, ""]) -> State:
    """Drop the commanded velocity, which the navigator's state has too."""
    return State(lgmd=state.detector, navigator=state.policy, cpg=state.cpg, is_first=is_first)
