"""Hemifields: overlap, mirror symmetry, refused values."""

import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.sensors import hemifield


@pytest.mark.parametrize("width", [320, 81])
def test_hemifields_overlap_as_asked_and_mirror_each_other(width):
    images = np.tile(np.arange(float(width)), (2, 3, 1))
    for overlap in (0.5, 0.6, 1.0):
        left = hemifield.crop(images, hemifield.LEFT, overlap)
        right = hemifield.crop(images, hemifield.RIGHT, overlap)
        assert left.shape == right.shape == (2, 3, np.ceil(overlap * width))
        np.testing.assert_array_equal(left, (width - 1 - right)[..., ::-1])
        assert left[0, 0, 0] == 0 and right[0, 0, -1] == width - 1


@pytest.mark.parametrize(("side", "overlap"), [(0, 0.4), (1, 1.1), (0, float("nan")), (2, 0.6)])
def test_impossible_hemifields_are_refused(side, overlap):
    with pytest.raises(InputError, match="expected"):
        hemifield.crop(np.zeros((4, 8)), side, overlap)
