"""Direction selective networks: cell by cell; each misses motion in its direction, and approach excites all four."""

from dataclasses import replace

import clips
import jax.numpy as jnp
import numpy as np
import pytest
from reference import dsn as reference

from lgmdjax.detectors import dsn
from lgmdjax.errors import InputError

LEFT, RIGHT, UP, DOWN = range(4)
NAMES = ("u", "excitation", "feed_forward", "networks")


@pytest.mark.parametrize(("delay", "suppression"), [(1, 25.0), (2, 9.0)])
def test_equals_the_equations_cell_by_cell(strict, delay, suppression):
    frames = clips.blobs(8, 40.0, 12, 16)
    frames[5:] = frames[4] + 0.2 * (frames[5:] - frames[4])
    response = clips.respond(dsn, dsn.Params(delay=delay, suppression=suppression), frames)
    expected = reference.dsn(frames, delay=delay, T_FFI=suppression)
    clips.assert_equals_reference(response, expected, NAMES, 1e-6)


def passing(turns: int):
    """Return frames of a bar that moves to the right at 2 cells a frame, or turned counter-clockwise."""
    frames = np.full((8, 24, 24), 160.0)
    for k in range(8):
        frames[k, 8:16, 2 * k : 2 * k + 6] = 40.0
    return np.rot90(frames, turns, axes=(1, 2)).copy()


@pytest.mark.parametrize(("turns", "blind"), [(0, RIGHT), (1, UP), (2, LEFT), (3, DOWN)])
def test_each_network_misses_motion_in_its_direction(turns, blind):
    """Yue & Rind: strong response to motion in three directions, weak in the one that inhibition follows."""
    response = clips.respond(dsn, dsn.Params(), passing(turns))
    networks = np.asarray(response.networks)[2:].mean(axis=0)
    others = np.delete(networks, blind)
    assert networks[blind] < 0.05 * others.min()
    assert np.asarray(response.u)[2:].max() < 0.52  # one of the four is silent, so the fusion is


def test_approach_excites_all_four_networks_and_the_fusion():
    """A square that grows by a cell a frame on each side."""
    frames = np.full((8, 24, 24), 160.0)
    for k in range(8):
        frames[k, 10 - k : 14 + k, 10 - k : 14 + k] = 40.0
    response = clips.respond(dsn, dsn.Params(), frames)
    networks = np.asarray(response.networks)[2:]
    np.testing.assert_allclose(networks, networks[:, :1] * np.ones(4), rtol=1e-6)  # by symmetry
    assert (np.diff(networks[:, 0]) > 0).all()
    assert response.u[-1] > 0.9


@pytest.mark.usefixtures("unchecked")
def test_unsuitable_constants_and_frames_are_refused():
    with pytest.raises(InputError, match="got 0 and 1"):
        dsn.init(dsn.Params(reach=0), jnp.zeros((6, 8)))
    state = dsn.init(dsn.Params(), jnp.zeros((6, 8)))
    with pytest.raises(InputError, match="8 x 6 cells as before"):
        dsn.step(replace(dsn.Params()), state, jnp.zeros((5, 8)))
