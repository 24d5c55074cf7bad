"""Hemifields: overlap, mirror symmetry, refused values."""

import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.sensors import hemifield


@pytest.mark.parametrize("width", [320, 81])
def test_hemifields_overlap_as_asked_and_mirror_each_other(width):
    images = np.tile(np.arange(float(width)), (2, 3, 1))
    for overlap in (0.5, 0.6, 1.0):
        left = hemifield.crop(images, hemifield.LEFT, overlap=overlap)
        right = hemifield.crop(images, hemifield.RIGHT, overlap=overlap)
        assert left.shape == right.shape == (2, 3, np.ceil(overlap * width))
        np.testing.assert_array_equal(left, (width - 1 - right)[..., ::-1])
        assert left[0, 0, 0] == 0 and right[0, 0, -1] == width - 1


@pytest.mark.parametrize(("height", "width"), [(240, 320), (61, 81)])
def test_the_ground_is_left_out_on_both_sides_alike(height, width):
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    kept = (column < width / 2) & (row < height / 2)
    for side, expected in ((hemifield.LEFT, kept), (hemifield.RIGHT, kept[:, ::-1])):
        found = np.zeros((height, width), bool)
        hemifield.crop(found, side, overlap=0.5, ground=0.5)[:] = True
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("side", "field"),
    [
        (0, {"overlap": 0.4}),
        (1, {"overlap": 1.1}),
        (0, {"overlap": float("nan")}),
        (2, {"overlap": 0.6}),
        (0, {"overlap": 0.5, "ground": 1.0}),
        (0, {"overlap": 0.5, "ground": float("nan")}),
    ],
)
def test_impossible_hemifields_are_refused(side, field):
    with pytest.raises(InputError, match="expected"):
        hemifield.crop(np.zeros((4, 8)), side, **field)
