"""Variations of rooms for training: obstacles overhead, and obstacles that move into the robot's way.

A navigator that met none of them in training turns round in front of every table top and walks into every box that
somebody puts in front of it.

| symbol | name                                                      | unit | where                                   |
| ------ | --------------------------------------------------------- | ---- | --------------------------------------- |
| T, D   | time at which a crossing obstacle departs, its duration   | s    | uniform in `DEPARTS`, `DURATION`        |
| g      | gap between the robot and the obstacle that has arrived   | m    | uniform in `GAP`                        |
| e      | lateral offset of the obstacle's goal from the path       | m    | uniform in -`OFFSET` .. `OFFSET`        |
| l      | lateral distance from which it comes                      | m    | uniform in `LATERAL`, from either side  |
| w      | speed of a robot that walks straight ahead on free ground | m/s  | `FREE_SPEED`                            |
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgmdjax.geometry import rotate
from lgmdjax.world.arena import Arena
from lgmdjax.world.obstacles import Prisms, is_inactive, raise_prisms

DEPARTS, DURATION = (2.0, 12.0), (0.5, 4.0)
GAP, OFFSET, LATERAL = (0.2, 0.7), 0.3, (1.2, 2.5)
FREE_SPEED = 0.07
ROBOT_LENGTH = 0.2
"""Distance from the trunk's centre to the foremost point of the robot [m]."""
CROSSING_SHARE = 0.6
"""Probability that the first box, or the first cylinder, of a room crosses the path."""


def raise_obstacles(arena: Arena, key: Array, share: Float[Array, ""] | float) -> Arena:
    """Return the room with a share of its obstacles overhead: things that the robot sees and can walk under."""
    boxes, cylinders = len(arena.boxes.top), len(arena.cylinders.top)
    samples = _sample_uniform(key, (boxes + cylinders, 4))
    return dataclasses.replace(
        arena,
        boxes=raise_prisms(arena.boxes, samples[:boxes], share),
        cylinders=raise_prisms(arena.cylinders, samples[boxes:], share),
    )


def cross_path(
    arena: Arena, key: Array, start: Float[Array, "3"], share: Float[Array, ""] | float = CROSSING_SHARE
) -> Arena:
    """Return the room whose first box and first cylinder come from the side into the way of a robot.

    In the frame of the start, each moves from (a, e + l) or (a, e - l) to (a, e), where a = w (T + D) + g plus the
    distance to the foremost point of the robot plus the radius of the obstacle. A robot that has walked straight ahead
    is then g away from it. Obstacles that move may pass through others.

    Args:
        arena: the room; an inactive prism stays inactive.
        key: of the random numbers; box and cylinder are drawn independently.
        start: x, y [m] and yaw [rad] of the robot at time 0.
        share: probability that the box, or the cylinder, moves.
    """
    samples = _sample_uniform(key, (2, 7))
    return dataclasses.replace(
        arena,
        boxes=_cross_first(arena.boxes, samples[0], start, share),
        cylinders=_cross_first(arena.cylinders, samples[1], start, share),
    )


def _cross_first(
    prisms: Prisms, samples: Float[Array, "7"], start: Float[Array, "3"], share: Float[Array, ""] | float
) -> Prisms:
    """Return the prisms, the first of which crosses the path with probability `share`."""
    departs, duration, gap, lateral = (
        low + sample * (high - low)
        for sample, (low, high) in zip(samples[:4], (DEPARTS, DURATION, GAP, LATERAL), strict=True)
    )
    offset, side = OFFSET * (2.0 * samples[4] - 1.0), jnp.where(samples[5] < 0.5, 1.0, -1.0)
    radius = jnp.linalg.norm(prisms.half_size[0])  # of a box's circumscribed circle; 1.4 times a cylinder's
    ahead = FREE_SPEED * (departs + duration) + gap + ROBOT_LENGTH + radius
    ends = jnp.stack([jnp.stack([ahead, offset + side * lateral]), jnp.stack([ahead, offset])])
    centre, goal = start[:2] + rotate(ends, start[2])
    moves = (samples[6] < share) & ~is_inactive(prisms)[0]
    first = jax.tree.map(lambda leaf: leaf[0], prisms)
    crossing = dataclasses.replace(first, centre=centre, goal=goal, departs=departs, arrives=departs + duration)
    return jax.tree.map(lambda all, one: jnp.where(moves, all.at[0].set(one), all), prisms, crossing)


def _sample_uniform(key: Array, shape: tuple[int, ...]) -> Array:
    """Sample from 0 .. 1 in float32 and cast, so that a key gives the same room in both precisions."""
    return jax.random.uniform(key, shape, dtype=jnp.float32).astype(float)
