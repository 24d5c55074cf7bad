"""Responses of any looming detector to recorded walks, as the robot's eyes would have given them.

The teacher steers by the laser, so its walk does not depend on the detector: one recorded walk, rendered once
(`lgmdjax.simulation.rerender`), serves all detectors.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lgmdjax.control import controller
from lgmdjax.control.controller import Response
from lgmdjax.simulation import rollout, sharding
from lgmdjax.simulation.closed_loop import AnyArray
from lgmdjax.simulation.episodes import Walk

Pictures = Float[AnyArray, "robots frames 2 height columns"]


@jax.jit
def respond(params: controller.Params, pictures: Pictures, is_first: Bool[AnyArray, "robots frames"]) -> Response:
    """Return the responses of both detectors to walks; the axes of each field are (robot, frame, eye).

    The detectors start at the first frame, and again where `is_first`.

    Args:
        params: whose detectors respond.
        pictures: what the detectors see of every frame [grey], from `rerender.render_walks`.
        is_first: first frames after a start or reset.
    """

    def frame(_: None, states: PyTree, inputs: tuple[Array, Array]) -> tuple[PyTree, Response]:
        frames, first = inputs
        states = controller.restart_detectors(params, states, frames, first)
        return controller.step_detectors(params, states, frames)

    def work(pictures: Array, is_first: Array) -> Response:
        started = jax.vmap(lambda frames: controller.init_detectors(params, frames))(pictures[:, 0])
        return rollout.scan_batch(frame, None, started, (pictures, is_first))[1]

    return sharding.shard_robots(work, jnp.asarray(pictures, float), jnp.asarray(is_first))


def with_responses(walks: Sequence[Walk], params: controller.Params, pictures: Pictures) -> list[Walk]:
    """Return walks of equal length with the responses of other detectors in place of those that were recorded."""
    is_first = np.stack([walk.is_first for walk in walks])
    responses = jax.tree.map(np.asarray, respond(params, pictures, is_first))
    return [
        replace(walk, **{name: values[index].astype(walk.u.dtype) for name, values in vars(responses).items()})
        for index, walk in enumerate(walks)
    ]
