"""LPLC2: a population of neurons of the fruit fly, each of which responds to motion outward from its own centre.

One detector serves one eye. The dendrites of an LPLC2 neuron reach into the four layers of the lobula plate. Each layer
sees motion in one direction, and the dendrites in it spread in that direction from the neuron's centre, so outward
motion excites. Inward motion inhibits through interneurons. The units are spread over the frame.

| symbol | name                 | unit   | equation                                                              |
| ------ | -------------------- | ------ | --------------------------------------------------------------------- |
| M_d    | -                    | 1      | 100 max(motion in direction d, 0), of emd, midway between four cells  |
| d      | -                    | -      | right, up, left, down                                                 |
| w_e    | excitation_weights   | 1      | (K, K), of motion to the right; turned by 90 degrees for the others   |
| w_i    | inhibition_weights   | 1      | likewise                                                              |
| b_e    | intercept            | 1      | -                                                                     |
| b_i    | inhibition_intercept | 1      | -                                                                     |
| r_m    | response.units       | 1      | max(b_e + sum_d w_e M_d - sum_d max(b_i + w_i M_d, 0), 0), for unit m |
| E      | response.excitation  | 1      | mean of r_m over the units                                            |
| u      | response.u           | 0.5..1 | 1 / (1 + exp(-gain E))                                                |

Source: Klapoetke et al., "Ultra-selective looming detection from radial motion opponency", Nature 551, 2017, for the
anatomy; Zhou, Li, Kim, Lafferty & Clark, "Shallow neural networks trained to detect collisions recover features of
visual loom-selective neurons", eLife 11, 2022, for the equations: their model with rectified inhibition and with
symmetry under rotation, of K = 12 cells of 5 degrees. Their learned weights are not used. The weights here follow the
anatomy: 1 / (number of cells of a sector) in the sector of +-45 degrees to the right of the centre for w_e, and the
mirror image for w_i, in a disc of K cells. Other choices and differences:

| point    | Zhou et al.                    | here                                               |
| -------- | ------------------------------ | -------------------------------------------------- |
| K        | 12                             | 11, so that the middle is a cell                   |
| units    | 1 to 256, centred at random    | on a grid of every `stride`-th cell                |
| pooling  | sum over units, then over time | mean over units                                    |
| b_e, b_i | learned                        | -1, so that grating and turn do not pass (test); 0 |
| u        | learned gain and offset        | gain = 10, offset 0: u is 0.5 without motion       |

Cells should be about 5 degrees wide, like those of the fly: `emd.Params(pooling=...)`.

Gradient: exact almost everywhere; 0 where every unit is silent.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from lgmdjax.detectors import emd
from lgmdjax.detectors.cells import Scalar, correlate, rectify
from lgmdjax.errors import InputError

State = emd.State
SCALE = 100.0  # of M: a correlation of two changes of a tenth is 1
SIZE = 11  # K, cells

Weights = Float[Array, "K K"]


def sector(size: int, inward: bool = False) -> Float[np.ndarray, "K K"]:
    """Return equal weights in the sector of +-45 degrees to the right (or left) of the middle, which sum to 1.

    >>> sector(3).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    """
    if size < 3 or size % 2 == 0:
        raise InputError(f"lplc2 size: expected an odd number of cells, 3 or more, got {size}; change it")
    y, x = np.mgrid[:size, :size] - size // 2
    inside = (np.abs(y) <= x) & (x > 0) & (np.hypot(x, y) <= size / 2)
    inside = inside & ((np.abs(y) < x) | (size > 3))
    weights = inside / inside.sum()
    return weights[:, ::-1].copy() if inward else weights


@struct.dataclass(kw_only=True)
class Params:
    """Constants of the detector; the gain of `motion` is not used."""

    motion: emd.Params = struct.field(default_factory=emd.Params)
    excitation_weights: Weights = struct.field(default_factory=lambda: jnp.asarray(sector(SIZE), dtype=float))
    inhibition_weights: Weights = struct.field(default_factory=lambda: jnp.asarray(sector(SIZE, True), dtype=float))
    intercept: Scalar = -1.0  # b_e
    inhibition_intercept: Scalar = 0.0  # b_i
    gain: Scalar = 10.0
    stride: int = struct.field(pytree_node=False, default=2)  # cells between the centres of two units


@struct.dataclass(kw_only=True)
class Response:
    """Response of the detector to one frame."""

    u: Float[Array, ""]
    excitation: Float[Array, ""]  # E
    units: Float[Array, "unit_rows unit_columns"]  # r_m


def create(size: int) -> Params:
    """Return parameters for units of `size` x `size` cells; raise `InputError` for an even number."""
    weights = (jnp.asarray(sector(size, inward), dtype=float) for inward in (False, True))
    excitation, inhibition = weights
    return Params(excitation_weights=excitation, inhibition_weights=inhibition)


def init(params: Params, frame: Float[Array, "height width"]) -> State:
    """Return the state after a first frame, before any change."""
    return emd.init(params.motion, frame)


def step(params: Params, state: State, frame: Float[Array, "height width"]) -> tuple[State, Response]:
    """Process the next frame.

    Raises `InputError` during tracing if the frame differs in size from the last one or is not of floats.

    >>> state, response = step(Params(), init(Params(), jnp.zeros((12, 16))), jnp.ones((12, 16)))
    >>> response.units.shape, float(response.u)
    ((6, 8), 0.5)

    Args:
        params: of the detector.
        state: from the last frame.
        frame: grey levels 0..255.
    """
    state = emd.filter_frame(params.motion, state, frame)
    units = _units(params, directions(emd.correlate(state)))
    E = jnp.mean(units)
    return state, Response(u=jax.nn.sigmoid(params.gain * E), excitation=E, units=units)


def directions(field: emd.Motion) -> Float[Array, "4 rows columns"]:
    """Return M: motion to the right, up, to the left and down, midway between four cells."""
    right = SCALE * 0.5 * (field.rightward[:-1] + field.rightward[1:])
    up = SCALE * 0.5 * (field.upward[:, :-1] + field.upward[:, 1:])
    return rectify(jnp.stack([right, up, -right, -up]))


def _units(params: Params, M: Float[Array, "4 rows columns"]) -> Float[Array, "unit_rows unit_columns"]:
    excited, inhibited = (
        correlate(M, _turned(weights, M), weights.shape[0] // 2, weights.shape[0] // 2, params.stride)
        for weights in (params.excitation_weights, params.inhibition_weights)
    )
    inhibition = jnp.sum(rectify(inhibited + params.inhibition_intercept), axis=0)
    return rectify(jnp.sum(excited, axis=0) - inhibition + params.intercept)


def _turned(weights: Weights, like: Array) -> Float[Array, "4 K K"]:
    """Return the weights for each direction; turning counter-clockwise leads from right to up, left, down."""
    return jnp.stack([jnp.rot90(weights, turns) for turns in range(4)]).astype(like.dtype)
