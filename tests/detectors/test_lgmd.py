"""One eye: the paper's equations cell by cell, what it should and should not fire at, bad pictures."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import lgmd as reference
from scipy import ndimage

from lgmdjax.detectors import lgmd
from lgmdjax.errors import InputError
from lgmdjax.sensors import hemifield

HEIGHT, WIDTH = 60, 80


@jax.jit
def watch(params, frames):
    """Show a film; the response has one entry a frame after the first."""
    show = lambda state, frame: lgmd.step(params, state, frame)  # noqa: E731
    return jax.lax.scan(show, lgmd.init(params, frames[0]), frames[1:])[1]


def noise(frames, height, width, seed=0):
    return np.random.default_rng(seed).uniform(0, 255, (frames, height, width))


def disc(radius, x=WIDTH / 2, y=HEIGHT / 2):
    """Draw a dark disc on a bright ground, its edge one pixel wide, as a camera would."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    cover = np.clip(radius - np.hypot(column - x, row - y) + 0.5, 0, 1)
    return 200 - 160 * cover


def approach(frames=90):
    """A disc that comes at constant speed: its radius grows as 1 / distance."""
    return jnp.asarray(np.stack([disc(10 / d) for d in np.linspace(3, 0.42, frames)]))


def assert_equals_reference(frames, **printed):
    """Compare a film's u, FF and U with the transcription; T_f = 30 lies between loud and quiet noise."""
    expected = reference.lgmd(frames, 12.0, 30.0, **printed)
    params = lgmd.Params(threshold=12.0, suppression=30.0, **printed)
    response = watch(params, jnp.asarray(frames, dtype=float))
    for name in ("u", "feed_forward", "excitation"):
        values = [cells[name] for cells in expected]
        np.testing.assert_allclose(getattr(response, name), values, rtol=1e-4, atol=1e-4)


def test_equals_the_paper_cell_by_cell(precision, strict):
    """Loud and quiet noise, which T_f tells apart; a film that is lower than the kernel."""
    assert_equals_reference(np.concatenate([noise(4, 13, 17), 0.2 * noise(4, 13, 17)]))
    assert_equals_reference(0.3 * noise(4, 4, 9))


def test_a_pooled_detector_is_that_of_a_coarser_picture(precision, strict):
    """Blocks of 3 x 3 pixels averaged by hand, then the paper's equations."""
    frames = 0.1 * noise(6, 27, 36)
    blocks = frames.reshape(6, 9, 3, 12, 3).mean(axis=(2, 4))
    expected = reference.lgmd(blocks, 2.0, 30.0)
    response = watch(lgmd.Params(threshold=2.0, suppression=30.0, pooling=3), jnp.asarray(frames, dtype=float))
    np.testing.assert_allclose(response.u, [cells["u"] for cells in expected], rtol=1e-4, atol=1e-4)
    assert np.ptp(response.u) > 0.01


def test_pooling_shares_a_picture_evenly_and_keeps_its_mirror_image():
    """Ten pixels among three cells: the middle one gets two thirds of the fourth and of the seventh."""
    picture = jnp.asarray(noise(1, 10, 10)[0])
    cells = lgmd.pool(lgmd.Params(pooling=3), picture)
    share = np.zeros((3, 10))
    share[0, :4], share[1, 3:7], share[2, 6:] = (1, 1, 1, 1 / 3), (2 / 3, 1, 1, 2 / 3), (1 / 3, 1, 1, 1)
    np.testing.assert_allclose(cells, 0.3 * share @ picture @ (0.3 * share).T, rtol=1e-12)
    np.testing.assert_allclose(lgmd.pool(lgmd.Params(pooling=3), picture[:, ::-1]), cells[:, ::-1], rtol=1e-12)
    np.testing.assert_allclose(cells.mean(), picture.mean(), rtol=1e-12)


@pytest.mark.parametrize("printed", [{"printed_feed_forward": True}, {"printed_gate": True}])
def test_equals_the_printed_equations_on_request(printed):
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
    picture = noise(1, 30, 41)[0]
    expected = ndimage.correlate(picture, kernel, mode="constant")
    np.testing.assert_allclose(lgmd.inhibit(jnp.asarray(kernel), jnp.asarray(picture)), expected, rtol=1e-10)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_still_picture_leaves_the_cell_at_rest(precision, smooth):
    frames = jnp.asarray(np.tile(noise(1, HEIGHT, WIDTH), (4, 1, 1)), dtype=float)
    response = watch(lgmd.Params(smooth=smooth), frames)
    np.testing.assert_array_equal(response.u, 0.5)
    np.testing.assert_array_equal(response.excitation, 0.0)


def test_fires_harder_the_nearer_the_disc_is():
    u = watch(lgmd.Params(threshold=8.0), approach()).u
    thirds = u[-60:].reshape(6, 10).mean(axis=1)  # of a second
    assert np.all(np.diff(thirds) > 0), thirds
    assert u[-1] > 0.9
    assert u[5:20].max() < 0.6


def test_approach_beats_recession():
    """The same pictures backward: at equal sizes of the disc, and in all, the cell fires less."""
    film, params = approach(), lgmd.Params(threshold=8.0, suppression=1e9)
    coming = watch(params, film).excitation[2:-2]
    leaving = watch(params, film[::-1]).excitation[::-1][2:-2]
    assert coming.sum() > 1.05 * leaving.sum()
    assert np.all((coming - leaving)[-40:].reshape(8, 5).mean(axis=1) > 0)


def test_approach_beats_translation():
    """A disc of the same size whose edge sweeps sideways as fast as the other's grows."""
    film, params = approach(), lgmd.Params(threshold=8.0, suppression=1e9)
    radius = 10 / np.linspace(3, 0.42, 90)
    coming = watch(params, film).excitation
    for k in (60, 70, 80):
        speed = radius[k] - radius[k - 1]
        passing = np.stack([disc(radius[k], x=WIDTH / 2 + speed * (i - 4)) for i in range(5)])
        assert coming[k - 1] > 1.2 * watch(params, jnp.asarray(passing)).excitation[-1]


def test_a_fast_turn_silences_the_cell_and_the_printed_equations_do_not_see_it():
    """A textured panorama swings by 6 pixels a frame."""
    panorama = ndimage.gaussian_filter(noise(1, HEIGHT, WIDTH + 120)[0], 1.5) * 6 % 255
    turn = jnp.asarray(np.stack([panorama[:, 6 * i : 6 * i + WIDTH] for i in range(12)]))
    silenced = watch(lgmd.Params(suppression=20.0), turn)
    np.testing.assert_array_equal(silenced.u[1:], 0.5)
    assert np.all(silenced.feed_forward[1:] > 20)
    unseen = watch(lgmd.Params(suppression=20.0, printed_feed_forward=True), turn)
    assert np.all(np.abs(unseen.feed_forward) < 5)
    assert np.all(unseen.u > 0.9)
    np.testing.assert_array_equal(watch(lgmd.Params(printed_gate=True), approach()).u, 0.5)


def test_smooth_thresholds_tend_to_the_hard_ones(precision):
    frames = jnp.asarray(np.concatenate([approach(30), 40 + 0.2 * noise(10, HEIGHT, WIDTH)]), dtype=float)
    hard = watch(lgmd.Params(suppression=5.0), frames)
    assert 0 < np.mean(hard.u == 0.5) < 1

    def difference(width):
        params = lgmd.Params(suppression=5.0, smooth=True, threshold_width=width, suppression_width=width)
        return float(jnp.abs(watch(params, frames).u - hard.u).mean())

    errors = [difference(width) for width in (3.0, 1.0, 0.3, 0.1, 0.01)]
    assert errors == sorted(errors, reverse=True), errors
    assert errors[-1] < 1e-4 < errors[0]


def test_gradient_reaches_every_constant_through_the_smooth_form(precision, strict):
    """Forward equals reverse; T_s and T_f have none through the steps, the others have."""
    frames = jnp.asarray(0.1 * noise(4, 12, 14), dtype=float)

    def told(params):
        return watch(params, frames).u.sum()

    params = lgmd.Params(threshold=3.0, suppression=8.0, smooth=True)
    reverse = jax.jit(jax.grad(told))(params)
    for name, leaf in vars(reverse).items():
        assert isinstance(leaf, bool) or (np.all(np.isfinite(leaf)) and np.any(np.abs(leaf) > 1e-9)), name
    tangents = jax.tree.map(lambda leaf: jnp.cos(jnp.asarray(leaf)), params)
    _, forward = jax.jit(lambda p, t: jax.jvp(told, (p,), (t,)))(params, tangents)
    products = jax.tree.map(lambda gradient, tangent: jnp.sum(gradient * tangent), reverse, tangents)
    np.testing.assert_allclose(forward, sum(jax.tree.leaves(products)), rtol=1e-4)
    np.testing.assert_allclose(reverse.kernel, reverse.kernel[::-1, ::-1], rtol=1e-5)
    hard = jax.jit(jax.grad(told))(replace(params, smooth=False, suppression=1e3))
    assert hard.threshold == hard.suppression == 0
    assert abs(hard.inhibition) > 1e-9 and np.all(np.isfinite(hard.kernel))


@pytest.mark.parametrize("smooth", [False, True])
def test_gradient_is_finite_where_nothing_moves(smooth):
    picture = jnp.full((6, 7), 80.0)
    told = lambda params: lgmd.step(params, lgmd.init(params, picture), picture)[1].u  # noqa: E731
    gradient = jax.jit(jax.grad(told))(lgmd.Params(smooth=smooth))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


def test_mirrored_pictures_give_the_same_response():
    frames = jnp.asarray(noise(5, 20, 31))
    for flipped in (frames[:, :, ::-1], frames[:, ::-1]):
        np.testing.assert_allclose(watch(lgmd.Params(), flipped).u, watch(lgmd.Params(), frames).u, rtol=1e-12)


@pytest.mark.parametrize("width", [320, 81])
def test_hemifields_overlap_as_asked_and_mirror_each_other(width):
    pictures = np.tile(np.arange(float(width)), (2, 3, 1))
    for overlap in (0.5, 0.6, 1.0):
        left = hemifield.hemifield(pictures, hemifield.LEFT, overlap)
        right = hemifield.hemifield(pictures, hemifield.RIGHT, overlap)
        assert left.shape == right.shape == (2, 3, np.ceil(overlap * width))
        np.testing.assert_array_equal(left, (width - 1 - right)[..., ::-1])
        assert left[0, 0, 0] == 0 and right[0, 0, -1] == width - 1


@pytest.mark.parametrize(("side", "overlap"), [(0, 0.4), (1, 1.1), (0, float("nan")), (2, 0.6)])
def test_a_hemifield_that_is_none_is_refused(side, overlap):
    with pytest.raises(InputError, match="expected"):
        hemifield.hemifield(np.zeros((4, 8)), side, overlap)


@pytest.mark.usefixtures("unchecked")
def test_pictures_that_do_not_fit_are_refused():
    params, picture = lgmd.Params(), jnp.zeros((6, 8))
    state = lgmd.init(params, picture)
    with pytest.raises(InputError, match=r"8 x 6 cells as before, got 8 x 5.*init again"):
        lgmd.step(params, state, jnp.zeros((5, 8)))
    with pytest.raises(InputError, match=r"uint8.*astype"):
        lgmd.init(params, jnp.zeros((6, 8), jnp.uint8))
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
def test_constants_that_make_no_sense_are_refused(wrong):
    lgmd.check(lgmd.Params())
    with pytest.raises(InputError, match=f"lgmd {next(iter(wrong))}: expected"):
        lgmd.check(lgmd.Params(**wrong))  # pyright: ignore[reportArgumentType]
