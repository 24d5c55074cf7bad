"""The pictures of a recorded walk are what the walking robots saw."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.sensors import camera
from lgmdjax.simulation import closed_loop, episodes, rerender, rollout, room_batches

ROBOTS = 4  # two a device
EYES = camera.Params(width=80, height=60, overlap=0.6)
FRAMES = 45  # more than one call of the drawing program, and less than two


@pytest.mark.slow
@pytest.mark.usefixtures("float32")
def test_pictures_are_drawn_again_from_the_poses(tmp_path):
    """From Parquet, to the last bit as the walking robots saw them, whatever part of the walk is drawn."""
    bend = policies.Blind(velocity=jnp.asarray([1.0, 0.6]))
    params, model = closed_loop.assemble(bend, eyes=EYES), hexapod.build()
    rooms = room_batches.random_rooms(jax.random.key(1), ROBOTS, density=0.3)
    states, seen = rollout.start(params, model, rooms, driver=policies.BLIND), []
    writer = episodes.Writer(tmp_path, {})
    for _ in range(FRAMES):
        states, chunk = rollout.advance(params, model, rooms, states, driver=policies.BLIND, frames=1, draw=True)
        seen.append(np.array(states.controller.lgmd.frame))
        writer.write(chunk, episode=0, rooms=range(ROBOTS), seed=1)
    walked = episodes.batched(episodes.read(tmp_path))
    drawn = rerender.walks(EYES, rooms.arena, walked)
    np.testing.assert_array_equal(drawn, np.stack(seen, axis=1))
    assert np.ptp(drawn, axis=1).max() > 20  # the world does move
    part, turned = (jax.tree.map(lambda leaf, of=of: leaf[of], walked) for of in (np.s_[:, 7:11], np.s_[::-1]))
    np.testing.assert_array_equal(drawn[:, 7:11], rerender.walks(EYES, rooms.arena, part))
    their_rooms = jax.tree.map(lambda leaf: leaf[::-1], rooms.arena)
    np.testing.assert_array_equal(drawn[::-1], rerender.walks(EYES, their_rooms, turned))
