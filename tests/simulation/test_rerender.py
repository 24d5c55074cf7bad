"""Pictures rendered from a recorded walk are those of the rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.sensors import camera
from lgmdjax.simulation import assembly, episodes, rerender, rollout, room_batches

pytestmark = pytest.mark.optimised

ROBOTS = 4  # two on each device
CAMERA = camera.Params(width=80, height=60, overlap=0.6, ground=0.5)
FRAMES = 45  # more than one call of the rendering program, and less than two


@pytest.mark.slow
@pytest.mark.usefixtures("float32")
def test_pictures_are_rendered_again_from_the_poses(tmp_path):
    """From Parquet, to the last bit those of the rollout, whichever part of it is rendered."""
    curve = policies.BlindParams(velocity=jnp.asarray([1.0, 0.6]))
    params, model = assembly.assemble(curve, camera_params=CAMERA), hexapod.build()
    rooms = room_batches.random_rooms(jax.random.key(1), ROBOTS, density=0.3)
    blind = policies.BLIND
    states, frames = rollout.reset_batch(params, model, rooms, policy=blind), []
    writer = episodes.Writer(tmp_path, {})
    for _ in range(FRAMES):
        states, chunk = rollout.rollout_batch(params, model, rooms, states, True, policy=blind, frames=1)
        left, right = np.moveaxis(np.asarray(states.controller.detector.frame), 1, 0)
        frames.append(np.stack([left, right[..., ::-1]], axis=1))  # the detectors see the outermost column first
        writer.write(chunk, episode=0, rooms=range(ROBOTS), seed=1)
    record = episodes.stack_walks(episodes.read(tmp_path))
    pictures = rerender.render_walks(CAMERA, rooms.arena, record)
    np.testing.assert_array_equal(pictures, np.stack(frames, axis=1))
    assert np.ptp(pictures, axis=1).max() > 20  # the pictures do change
    part, reverse = (jax.tree.map(lambda leaf, of=of: leaf[of], record) for of in (np.s_[:, 7:11], np.s_[::-1]))
    np.testing.assert_array_equal(pictures[:, 7:11], rerender.render_walks(CAMERA, rooms.arena, part))
    reverse_rooms = jax.tree.map(lambda leaf: leaf[::-1], rooms.arena)
    np.testing.assert_array_equal(pictures[::-1], rerender.render_walks(CAMERA, reverse_rooms, reverse))
