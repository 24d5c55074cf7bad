"""New floor: which cells of 0.25 m a robot has entered since its episode began, and how much of each it has covered.

Of the two measures, only the second has a derivative that is not zero:

| measure | in a frame                                                              | derivative by the position     |
| ------- | ----------------------------------------------------------------------- | ------------------------------ |
| entered | 1 if the trunk's centre enters a cell for the first time, else 0        | zero                           |
| covered | sum over cells i of max(c_i, w_i(x)) - c_i; the maximum is the next c_i  | that of the w_i which grow     |

w_i(x) = max(0, 1 - |x - x_i| / CELL) max(0, 1 - |y - y_i| / CELL) is the share of a square of one cell around the robot
that lies in cell i. The shares sum to 1, so a robot that walks straight along an axis over new floor covers one cell
every 0.25 m, on any line, and both measures grow alike. `metrics.count_cells` counts the cells that a path averaged
over a gait cycle enters; `entered` can be a few more, because of sway.

The grid repeats every `GRID` cells, so no room may be larger.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from lgmdjax.evaluation.metrics import CELL
from lgmdjax.minmax import maximum

GRID = 64  # cells along each side
MAX_SIZE = GRID * CELL  # m, of a room


@struct.dataclass(kw_only=True)
class State:
    """The floor that a robot has seen since its episode began."""

    entered: Bool[Array, "GRID GRID"]
    covered: Float[Array, "GRID GRID"]  # c, 0..1


def init(position: Float[Array, "2"]) -> State:
    """Return the state of a robot that stands at its first position [m]: that floor is not new."""
    return State(
        entered=jnp.zeros((GRID, GRID), bool).at[_cell(position)].set(True),
        covered=_shares(position),
    )


def step(state: State, position: Float[Array, "2"]) -> tuple[State, tuple[Float[Array, ""], Float[Array, ""]]]:
    """Return the state at the next position [m], and what is new: cells entered (0 or 1), and cells covered.

    Gradient: of the second, as in the table.
    """
    cell = _cell(position)
    entered = 1 - state.entered[cell].astype(position.dtype)
    covered = maximum(_shares(position), state.covered)
    new = jnp.sum(covered - state.covered)
    return State(entered=state.entered.at[cell].set(True), covered=covered), (entered, new)


def covered_at(state: State, position: Float[Array, "2"]) -> Float[Array, ""]:
    """Return how much of the floor at a position [m] is covered, 0..1, interpolated between the cells' centres.

    Gradient: by the position too; it jumps at the centres.
    """
    return jnp.sum(_shares(position) * state.covered)


def _cell(position: Float[Array, "2"]) -> tuple[Array, Array]:
    """Return the row and the column of a position."""
    row, column = jnp.floor(position / CELL).astype(jnp.int32) % GRID
    return row, column


def _shares(position: Float[Array, "2"]) -> Float[Array, "GRID GRID"]:
    """Return the share of a square of one cell around the position that lies in each cell."""
    offsets = position[:, None] / CELL - (jnp.arange(GRID, dtype=position.dtype) + 0.5)
    nearest = offsets - GRID * jnp.round(offsets / GRID)
    along_x, along_y = maximum(1 - jnp.abs(nearest), 0.0)
    return along_x[:, None] * along_y[None, :]
