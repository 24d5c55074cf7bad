"""LGMD1 with grouping: the paper cell by cell; clusters pass and noise does not; approach; feed-forward inhibition."""

import clips
import jax.numpy as jnp
import numpy as np
import pytest
from reference import lgmd1_grouping as reference

from lgmdjax.detectors import lgmd1_grouping
from lgmdjax.errors import InputError

FRAMES = np.concatenate([clips.blobs(4, 12.0), clips.blobs(4, 60.0, seed=1)])


@pytest.mark.parametrize("options", [{}, {"persistence": 0.3}, {"magnitudes": True}])
def test_equals_the_paper_cell_by_cell(strict, options):
    """For weak and strong changes, between which T_FFI lies."""
    expected = reference.lgmd1_grouping(FRAMES, 20.0, **options)
    params = lgmd1_grouping.Params(suppression=20.0, **options)
    clips.assert_equals_reference(clips.respond(lgmd1_grouping, params, FRAMES), expected)
    assert {cells["feed_forward"] >= 20 for cells in expected} == {True, False}


def test_an_edge_passes_where_noise_of_the_same_change_does_not():
    """The paper's feature enhancement: a bar passes, cells apart do not. Without the bar nothing sets the scale."""
    still = np.zeros((24, 32))
    noise, both = still.copy(), still.copy()
    noise[1::4, 1:16:4] = 12.0
    both[:] = noise
    both[6:18, 22:25] = 12.0
    params = lgmd1_grouping.Params()
    state = lgmd1_grouping.init(params, jnp.asarray(still))
    grouping = np.asarray(lgmd1_grouping.layers(params, state, jnp.asarray(both)).grouping)
    assert np.all(grouping[7:17, 22:25] > 30) and np.all(grouping[:, :20] == 0)
    assert np.all(np.asarray(lgmd1_grouping.layers(params, state, jnp.asarray(noise)).grouping)[noise > 0] > 30)


def test_response_increases_during_an_approach_of_either_contrast():
    for frames in (clips.approach(), clips.inverted(clips.approach())):
        excitation = np.asarray(clips.respond(lgmd1_grouping, lgmd1_grouping.Params(), frames).excitation)
        means = excitation[5:].reshape(-1, 10).mean(axis=1)
        assert np.all(np.diff(means) >= 0) and means[-1] > 10 * means[-2] > 0


def test_a_change_of_the_whole_image_is_suppressed_one_frame_later():
    frames = np.full((4, 24, 32), 100.0)
    frames[2:] = 160.0
    frames[3, 5:15, 5:15] = 40.0
    response = clips.respond(lgmd1_grouping, lgmd1_grouping.Params(), frames)
    np.testing.assert_allclose(response.feed_forward, [0, 0, 60])
    assert response.excitation[2] > 1 and response.u[2] == 0.5


@pytest.mark.usefixtures("unchecked")
def test_unsuitable_frames_are_refused():
    params = lgmd1_grouping.Params()
    state = lgmd1_grouping.init(params, jnp.zeros((6, 8)))
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5"):
        lgmd1_grouping.step(params, state, jnp.zeros((5, 8)))
    with pytest.raises(InputError, match=r"lgmd1_grouping: .*uint8"):
        lgmd1_grouping.init(params, jnp.zeros((6, 8), jnp.uint8))
