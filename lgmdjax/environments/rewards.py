"""Rewards: the outcome of a frame, and two functions of it. Your own reward is a function of `Outcome` too.

| name  | reward of a frame                                                                                 |
| ----- | ------------------------------------------------------------------------------------------------- |
| cells | cells of 0.25 m entered for the first time, less `END_COST` for a touch or a fall                  |
| floor | floor covered for the first time [cells], less `END_COST` for a touch or a fall, less               |
|       | `NEAR_COST` max(0, 1 - clearance / `NEAR`)^2                                                        |

`floor` is for methods that use the derivative; that of `cells` is zero, and so is that of a touch. Both rewards are
about 20 a minute for a robot that avoids obstacles and keeps walking (`lgmdjax.evaluation.metrics`, coverage).
"""

from collections.abc import Callable
from typing import Literal, get_args

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from lgmdjax.errors import InputError
from lgmdjax.minmax import maximum

END_COST = 10.0  # cells, of a touch or a fall: half a minute of walking over new floor
NEAR = 0.15  # m, clearance below which `floor` is reduced
NEAR_COST = 0.02  # cells a frame, at a clearance of zero

RewardName = Literal["cells", "floor"]
"""Names of the rewards of this module."""


@struct.dataclass(kw_only=True)
class Outcome:
    """The outcome of one frame."""

    position: Float[Array, "3"]  # m, of the trunk
    quaternion: Float[Array, "4"]  # w x y z
    velocity: Float[Array, "2"]  # commanded, left and right, nominal (0.05 m/s); zero if joints are commanded
    clearance: Float[Array, ""]  # m, smallest within the frame
    new_cells: Float[Array, ""]  # entered for the first time (`coverage`)
    new_floor: Float[Array, ""]  # covered for the first time, cells (`coverage`)
    touched: Bool[Array, ""]  # a wall or an obstacle
    fell: Bool[Array, ""]  # or its state is not finite


Reward = Callable[[Outcome], Float[Array, ""]]
"""A pure function that JAX can trace, from the outcome of a frame to its reward."""


def cells(outcome: Outcome) -> Float[Array, ""]:
    """Return the cells entered for the first time, less the cost of a touch or a fall."""
    return outcome.new_cells - _end_cost(outcome)


def floor(outcome: Outcome) -> Float[Array, ""]:
    """Return the floor covered for the first time [cells], less the costs of a touch, of a fall, and of being near.

    Gradient: by the position (`coverage.step`) and by the clearance.
    """
    nearness = maximum(1 - outcome.clearance / NEAR, 0.0)
    return outcome.new_floor - _end_cost(outcome) - NEAR_COST * nearness**2


REWARDS: dict[RewardName, Reward] = {"cells": cells, "floor": floor}


def get_reward(reward: RewardName | Reward) -> Reward:
    """Return the reward of this name, or the function itself; raise `InputError` for an unknown name.

    >>> get_reward("cells") is cells
    True
    """
    if isinstance(reward, str):
        if reward not in REWARDS:
            raise InputError(
                f"reward: expected {' or '.join(get_args(RewardName))} or a function of the outcome, got {reward!r}; "
                "see lgmdjax.environments.rewards"
            )
        return REWARDS[reward]
    return reward


def _end_cost(outcome: Outcome) -> Float[Array, ""]:
    return END_COST * (outcome.touched | outcome.fell).astype(jnp.result_type(float))
