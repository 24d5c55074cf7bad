"""The LGMD of one eye: the paper's equations cell by cell, its selectivity, gradients, refused input."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import lgmd as reference
from scipy import ndimage

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError

HEIGHT, WIDTH = 60, 80


@jax.jit
def respond(params, frames):
    """Return the responses to all frames after the first."""
    return jax.lax.scan(partial(lgmd.step, params), lgmd.init(params, frames[0]), frames[1:])[1]


def noise(frames, height, width, seed=0):
    return np.random.default_rng(seed).uniform(0, 255, (frames, height, width))


def disc(radius, x=WIDTH / 2, y=HEIGHT / 2):
    """Return the image of a dark disc on a bright ground, with an edge one pixel wide."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    coverage = np.clip(radius - np.hypot(column - x, row - y) + 0.5, 0, 1)
    return 200 - 160 * coverage


def approach(frames=90):
    """Return the images of a disc that approaches at constant speed: its radius grows as 1 / distance."""
    return jnp.asarray(np.stack([disc(10 / d) for d in np.linspace(3, 0.42, frames)]))


def assert_equals_reference(frames, params=None, **printed):
    """Compare u, FF and U with the transcription; T_f = 30 lies between strong and weak noise."""
    expected = reference.lgmd(frames, 12.0, 30.0, **printed)
    params = params or lgmd.Params(threshold=12.0, suppression=30.0, **printed)
    response = respond(params, jnp.asarray(frames, dtype=float))
    for name in ("u", "feed_forward", "excitation"):
        values = [cells[name] for cells in expected]
        np.testing.assert_allclose(getattr(response, name), values, rtol=1e-4, atol=1e-4)


def test_equals_the_paper_cell_by_cell(precision, strict):
    """For strong and weak noise, between which T_f lies, and for frames with fewer rows than the kernel."""
    assert_equals_reference(np.concatenate([noise(4, 13, 17), 0.2 * noise(4, 13, 17)]))
    assert_equals_reference(0.3 * noise(4, 4, 9))


@pytest.mark.parametrize(("outer", "inner"), [(85.0, 0.0), (85.0, -40.0), (10.0, 0.0)])
def test_falloff_weighs_cells_by_their_bearing(outer, inner):
    edges = math.radians(outer), math.radians(inner)
    params = lgmd.Params(threshold=12.0, suppression=30.0, falloff=2.0, edges=edges)
    frames = np.concatenate([noise(4, 13, 17), 0.2 * noise(4, 13, 17)])
    assert_equals_reference(frames, params, falloff=2.0, outer=outer, inner=inner)
    assert lgmd.column_weights(params, 17).mean() == pytest.approx(1)


def test_falloff_makes_passing_edges_alike_wherever_they_are():
    """Edges at one distance y beside the path move at v sin(theta)^2 / y; each column has one of them."""
    params = lgmd.Params(falloff=2.0, edges=(math.radians(85), math.radians(21)))
    theta = np.deg2rad(85 - 64 * (np.arange(16) + 0.5) / 16)
    responses = lgmd.column_weights(params, 16) * np.sin(theta) ** 2
    np.testing.assert_allclose(responses, responses[0], rtol=1e-9)


def test_pooling_equals_a_coarser_image(precision, strict):
    """Blocks of 3 x 3 pixels are averaged in NumPy, then the paper's equations apply."""
    frames = 0.1 * noise(6, 27, 36)
    blocks = frames.reshape(6, 9, 3, 12, 3).mean(axis=(2, 4))
    expected = reference.lgmd(blocks, 2.0, 30.0)
    response = respond(lgmd.Params(threshold=2.0, suppression=30.0, pooling=3), jnp.asarray(frames, dtype=float))
    np.testing.assert_allclose(response.u, [cells["u"] for cells in expected], rtol=1e-4, atol=1e-4)
    assert np.ptp(response.u) > 0.01


def test_pooling_divides_an_image_evenly_and_keeps_mirror_symmetry():
    """Ten pixels for three cells: the middle one has two thirds of the fourth and of the seventh pixel."""
    image = jnp.asarray(noise(1, 10, 10)[0])
    cells = lgmd.pool(lgmd.Params(pooling=3), image)
    weights = np.zeros((3, 10))
    weights[0, :4], weights[1, 3:7], weights[2, 6:] = (1, 1, 1, 1 / 3), (2 / 3, 1, 1, 2 / 3), (1 / 3, 1, 1, 1)
    np.testing.assert_allclose(cells, 0.3 * weights @ image @ (0.3 * weights).T, rtol=1e-12)
    np.testing.assert_allclose(lgmd.pool(lgmd.Params(pooling=3), image[:, ::-1]), cells[:, ::-1], rtol=1e-12)
    np.testing.assert_allclose(cells.mean(), image.mean(), rtol=1e-12)


def test_pooling_of_an_8_bit_frame_is_exact(precision, strict):
    """The quotient of whole numbers, rounded once: the cells of 80 x 60 pixels have 40 x 3 parts of a pixel."""
    frame = np.random.default_rng(0).integers(0, 256, (60, 40), np.uint8)
    sums = np.repeat(frame.reshape(20, 3, 40).sum(axis=1, dtype=np.int64), 13, axis=1).reshape(20, 13, 40).sum(axis=2)
    pool = partial(lgmd.pool, lgmd.Params(pooling=3))
    quotient = sums.astype(precision) / np.asarray(120, precision)
    np.testing.assert_array_equal(jax.jit(pool)(frame), quotient)
    # Also where the compiler could fuse a product into the difference of two frames.
    np.testing.assert_array_equal(jax.jit(lambda a, b: pool(a) - b)(frame, quotient[::-1]), quotient - quotient[::-1])
    np.testing.assert_allclose(pool(jnp.asarray(frame, dtype=float)), quotient, rtol=1e-6)


@pytest.mark.parametrize("printed", [{"printed_feed_forward": True}, {"printed_gate": True}])
def test_equals_the_printed_equations_on_demand(printed):
    assert_equals_reference(np.concatenate([noise(4, 13, 17), 0.2 * noise(4, 13, 17)]), **printed)


def test_layers_equal_the_paper_cell_by_cell(precision):
    frames = noise(5, 13, 17)
    cells = reference.lgmd(frames, 12.0, 30.0)[-1]
    last, now, before = (jnp.asarray(frames[k], dtype=float) for k in (-2, -1, -3))
    layers = lgmd.layers(lgmd.Params(), lgmd.State(frame=last, difference=last - before), now)
    for name, symbol in (("excitation", "E"), ("inhibition", "I"), ("summation", "S")):
        np.testing.assert_allclose(getattr(layers, name), cells[symbol], atol=1e-3)


def test_inhibition_is_a_correlation_with_any_symmetric_kernel():
    kernel = np.random.default_rng(1).uniform(0, 1, (5, 5))
    kernel = sum((kernel, kernel[::-1], kernel[:, ::-1], kernel[::-1, ::-1])) / 4
    image = noise(1, 30, 41)[0]
    expected = ndimage.correlate(image, kernel, mode="constant")
    np.testing.assert_allclose(lgmd.inhibit(jnp.asarray(kernel), jnp.asarray(image)), expected, rtol=1e-10)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_static_image_gives_the_resting_response(precision, smooth):
    frames = jnp.asarray(np.tile(noise(1, HEIGHT, WIDTH), (4, 1, 1)), dtype=float)
    response = respond(lgmd.Params(smooth=smooth), frames)
    np.testing.assert_array_equal(response.u, 0.5)
    np.testing.assert_array_equal(response.excitation, 0.0)


def test_response_increases_during_an_approach():
    u = respond(lgmd.Params(threshold=8.0), approach()).u
    means = u[-60:].reshape(6, 10).mean(axis=1)  # over a third of a second each
    assert np.all(np.diff(means) > 0), means
    assert u[-1] > 0.9
    assert u[5:20].max() < 0.6


def test_approach_beats_recession():
    """The same images in reverse excite less, at equal sizes of the disc and in the sum."""
    frames, params = approach(), lgmd.Params(threshold=8.0, suppression=1e9)
    approaching = respond(params, frames).excitation[2:-2]
    receding = respond(params, frames[::-1]).excitation[::-1][2:-2]
    assert approaching.sum() > 1.05 * receding.sum()
    assert np.all((approaching - receding)[-40:].reshape(8, 5).mean(axis=1) > 0)


def test_approach_beats_translation():
    """The other disc has the same size and moves sideways as fast as the radius of the approaching one grows."""
    frames, params = approach(), lgmd.Params(threshold=8.0, suppression=1e9)
    radius = 10 / np.linspace(3, 0.42, 90)
    approaching = respond(params, frames).excitation
    for k in (60, 70, 80):
        speed = radius[k] - radius[k - 1]
        translating = np.stack([disc(radius[k], x=WIDTH / 2 + speed * (i - 4)) for i in range(5)])
        assert approaching[k - 1] > 1.2 * respond(params, jnp.asarray(translating)).excitation[-1]


def test_a_fast_turn_suppresses_the_response_but_not_with_the_printed_equations():
    """A textured panorama shifts by 6 pixels a frame."""
    panorama = ndimage.gaussian_filter(noise(1, HEIGHT, WIDTH + 120)[0], 1.5) * 6 % 255
    turn = jnp.asarray(np.stack([panorama[:, 6 * i : 6 * i + WIDTH] for i in range(12)]))
    suppressed = respond(lgmd.Params(suppression=20.0), turn)
    np.testing.assert_array_equal(suppressed.u[1:], 0.5)
    assert np.all(suppressed.feed_forward[1:] > 20)
    printed = respond(lgmd.Params(suppression=20.0, printed_feed_forward=True), turn)
    assert np.all(np.abs(printed.feed_forward) < 5)
    assert np.all(printed.u > 0.9)
    np.testing.assert_array_equal(respond(lgmd.Params(printed_gate=True), approach()).u, 0.5)


def test_smooth_thresholds_tend_to_the_hard_ones(precision):
    frames = jnp.asarray(np.concatenate([approach(30), 40 + 0.2 * noise(10, HEIGHT, WIDTH)]), dtype=float)
    hard = respond(lgmd.Params(suppression=5.0), frames)
    assert 0 < np.mean(hard.u == 0.5) < 1

    def difference(width):
        params = lgmd.Params(suppression=5.0, smooth=True, threshold_width=width, suppression_width=width)
        return float(jnp.abs(respond(params, frames).u - hard.u).mean())

    errors = [difference(width) for width in (3.0, 1.0, 0.3, 0.1, 0.01)]
    assert errors == sorted(errors, reverse=True), errors
    assert errors[-1] < 1e-4 < errors[0]


def test_gradient_reaches_every_constant_through_the_smooth_form(precision, strict):
    """Forward mode equals reverse mode; without `smooth` the gradients of T_s and T_f are zero, the others are not."""
    frames = jnp.asarray(0.1 * noise(4, 12, 14), dtype=float)

    def total_u(params):
        return respond(params, frames).u.sum()

    params = lgmd.Params(threshold=3.0, suppression=8.0, smooth=True)
    reverse = jax.jit(jax.grad(total_u))(params)
    for name, leaf in jax.tree_util.tree_leaves_with_path(reverse):
        assert np.all(np.isfinite(leaf)) and np.any(np.abs(leaf) > 1e-9), name
    tangents = jax.tree.map(lambda leaf: jnp.cos(jnp.asarray(leaf)), params)
    _, forward = jax.jit(lambda p, t: jax.jvp(total_u, (p,), (t,)))(params, tangents)
    products = jax.tree.map(lambda gradient, tangent: jnp.sum(gradient * tangent), reverse, tangents)
    np.testing.assert_allclose(forward, sum(jax.tree.leaves(products)), rtol=1e-4)
    np.testing.assert_allclose(reverse.kernel, reverse.kernel[::-1, ::-1], rtol=1e-5)
    hard = jax.jit(jax.grad(total_u))(replace(params, smooth=False, suppression=1e3))
    assert hard.threshold == hard.suppression == 0
    assert abs(hard.inhibition) > 1e-9 and np.all(np.isfinite(hard.kernel))


@pytest.mark.parametrize("smooth", [False, True])
def test_gradient_is_finite_without_motion(smooth):
    image = jnp.full((6, 7), 80.0)
    u = lambda params: lgmd.step(params, lgmd.init(params, image), image)[1].u  # noqa: E731
    gradient = jax.jit(jax.grad(u))(lgmd.Params(smooth=smooth))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_mirrored_images_give_the_same_response():
    frames = jnp.asarray(noise(5, 20, 31))
    for flipped in (frames[:, :, ::-1], frames[:, ::-1]):
        np.testing.assert_allclose(respond(lgmd.Params(), flipped).u, respond(lgmd.Params(), frames).u, rtol=1e-12)


@pytest.mark.usefixtures("unchecked")
def test_unsuitable_frames_are_refused():
    params, image = lgmd.Params(), jnp.zeros((6, 8))
    state = lgmd.init(params, image)
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5.*init again"):
        lgmd.step(params, state, jnp.zeros((5, 8)))
    with pytest.raises(InputError, match=r"int16.*astype"):
        lgmd.init(params, jnp.zeros((6, 8), jnp.int16))
    with pytest.raises(InputError, match=r"vmap"):
        lgmd.init(params, jnp.zeros((2, 6, 8)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"threshold": -1.0},
        {"suppression": float("nan")},
        {"inhibition": float("inf")},
        {"threshold_width": 0.0},
        {"kernel": jnp.full((3, 3), 0.1)},
        {"kernel": jnp.asarray(lgmd.KERNEL).at[0, 0].set(0.5)},
        {"kernel": -jnp.asarray(lgmd.KERNEL)},
    ],
)
def test_impossible_parameters_are_refused(wrong):
    lgmd.check(lgmd.Params())
    with pytest.raises(InputError, match=f"lgmd {next(iter(wrong))}: expected"):
        lgmd.check(lgmd.Params(**wrong))  # pyright: ignore[reportArgumentType]
