"""D-LGMD: the program cell by cell; the latency of inhibition; preference for fast edges and for approach."""

import clips
import jax.numpy as jnp
import numpy as np
import pytest
from reference import d_lgmd as reference

from lgmdjax.detectors import d_lgmd
from lgmdjax.errors import InputError


@pytest.mark.parametrize("interpolated", [False, True])
def test_equals_the_program_cell_by_cell(strict, interpolated):
    frames = np.concatenate([clips.blobs(4, 120.0, 9, 12), clips.blobs(2, 20.0, 9, 12, seed=1)])
    expected = reference.d_lgmd(frames, 1.0, interpolated)
    params = d_lgmd.Params(threshold=1.0, interpolated=interpolated)
    clips.assert_equals_reference(clips.respond(d_lgmd, params, frames), expected, tolerance=1e-6)


def test_inhibition_grows_later_with_distance_and_outweighs_excitation():
    kernels = [np.asarray(kernel) for kernel in d_lgmd.kernels(d_lgmd.Params(interpolated=True))]
    middle = [kernel[6, 6:] for kernel in kernels]  # to the right of the cell
    later = (middle[1] + 2 * middle[2])[1:] / (middle[1] + middle[2])[1:]
    assert np.all(np.diff(later) >= 0) and later[0] < 1.1 < 1.8 < later[-1]
    assert kernels[0].sum() < kernels[1].sum() + kernels[2].sum()


def test_prefers_fast_edges():
    """The published tuning to angular velocity: excitation per moving edge rises with its speed."""
    excitation = [clips.respond(d_lgmd, d_lgmd.Params(), clips.translation(rate)).excitation.max() for rate in (0.5, 8)]
    assert excitation[1] > 10 * excitation[0]


def test_prefers_approach_to_translation():
    params, approach = d_lgmd.Params(interpolated=True), clips.approach(0.03)
    for frames in (approach, clips.inverted(approach)):
        peak = clips.respond(d_lgmd, params, frames).excitation.max()
        assert peak > 10 * clips.respond(d_lgmd, params, clips.translation(1.0)).excitation.max()


@pytest.mark.usefixtures("unchecked")
def test_unsuitable_frames_are_refused():
    state = d_lgmd.init(d_lgmd.Params(), jnp.zeros((6, 8)))
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5"):
        d_lgmd.step(d_lgmd.Params(), state, jnp.zeros((5, 8)))
