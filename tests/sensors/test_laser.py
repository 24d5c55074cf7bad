"""The laser scanner: bearings, ranges, and the distances of both hemifields."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import arena as reference

from lgmdjax.errors import InputError
from lgmdjax.sensors import laser
from lgmdjax.world import arena, scenes

PARAMS = laser.Params()
scan = jax.jit(partial(laser.scan, PARAMS))


def rotation_of(yaw: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """Return a rotation by yaw, then by pitch with the nose down."""
    c, s, p, q = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.array([[p, 0, q], [0, 1, 0], [-q, 0, p]])


def test_bearings_are_two_per_degree_from_right_to_left() -> None:
    bearings = np.rad2deg(laser.bearings(PARAMS))
    assert len(bearings) == 341
    np.testing.assert_allclose([bearings[0], bearings[170], bearings[-1]], [-85.0, 0.0, 85.0], atol=1e-12)
    np.testing.assert_allclose(np.diff(bearings), 0.5, atol=1e-12)


def test_ranges_in_an_empty_room_equal_trigonometry() -> None:
    """From the middle of 8 x 6 m: walls at 4 m ahead and 3 m aside."""
    room = arena.empty_room((8.0, 6.0))
    phi = np.deg2rad(np.linspace(-85.0, 85.0, 341))
    expected = np.minimum(4.0 / np.cos(phi), 3.0 / np.maximum(np.abs(np.sin(phi)), 1e-9))
    np.testing.assert_allclose(scan(room, jnp.asarray([0.0, 0.0, 0.2]), np.eye(3)), expected, atol=1e-9)


def test_ranges_of_a_turned_and_pitched_scanner_equal_mujoco() -> None:
    room = scenes.testing_room()
    position, rotation = np.array([0.4, 1.7, 0.16]), rotation_of(yaw=-1.9, pitch=0.05)
    phi = np.deg2rad(np.linspace(-85.0, 85.0, 341))
    directions = np.stack([np.cos(phi), np.sin(phi), 0 * phi], axis=-1) @ rotation.T
    model, data = reference.load(reference.to_mjcf(room))
    expected = np.minimum(reference.ray(model, data, np.tile(position, (341, 1)), directions), 5.0)
    assert expected.min() < 2.0 < expected.max()
    np.testing.assert_allclose(scan(room, position, rotation), expected, atol=1e-6)


def test_ranges_are_limited() -> None:
    ranges = scan(arena.empty_room((20.0, 20.0)), jnp.asarray([0.0, 0.0, 0.2]), np.eye(3))
    np.testing.assert_array_equal(ranges, 5.0)


def test_a_scanner_pitched_down_measures_the_floor() -> None:
    ranges = scan(arena.empty_room((20.0, 20.0)), jnp.asarray([0.0, 0.0, 0.2]), rotation_of(pitch=0.1))
    assert float(ranges[170]) == pytest.approx(0.2 / math.sin(0.1))


@pytest.mark.parametrize(("side", "near", "far"), [(1.0, 0, 1), (-1.0, 1, 0)])
def test_an_obstacle_on_one_side_counts_for_that_side(side: float, near: int, far: int) -> None:
    room = arena.empty_room((8.0, 8.0), cylinders=arena.make_prisms([[1.0, 0.8 * side]], 0.2, 1.0))
    distances = laser.hemifield_distances(scan(room, jnp.asarray([0.0, 0.0, 0.2]), np.eye(3)))
    # The nearest point need not be on a ray, but a ray passes within a quarter of a degree of it.
    assert float(distances[near]) == pytest.approx(math.hypot(1.0, 0.8) - 0.2, abs=1e-4)
    assert float(distances[far]) == pytest.approx(4.0 / math.cos(0.0), abs=1e-3)


def test_the_middle_ray_counts_for_both_sides() -> None:
    ranges = jnp.full(341, 5.0).at[170].set(1.0)
    np.testing.assert_array_equal(laser.hemifield_distances(ranges), [1.0, 1.0])
    np.testing.assert_array_equal(laser.hemifield_distances(ranges.at[171].set(0.5)), [0.5, 1.0])
    np.testing.assert_array_equal(laser.hemifield_distances(ranges.at[169].set(0.5)), [1.0, 0.5])


def test_hemifield_distances_keep_batch_axes() -> None:
    ranges = np.random.default_rng(0).uniform(0.5, 5.0, (7, 3, 341))
    both = np.stack([ranges[..., 170:].min(-1), ranges[..., :171].min(-1)], axis=-1)
    np.testing.assert_array_equal(laser.hemifield_distances(jnp.asarray(ranges)), both)


def test_mirrored_rooms_give_mirrored_scans() -> None:
    room = scenes.training_room()
    position, flip = np.array([0.3, 0.4, 0.2]), np.array([1.0, -1.0, 1.0])
    ranges = scan(room, position, rotation_of(yaw=0.7))
    swapped = scan(arena.mirror(room), position * flip, rotation_of(yaw=-0.7))
    np.testing.assert_allclose(ranges, swapped[::-1], atol=1e-9)


def test_gradient_passes_through_the_scan() -> None:
    """Moving back from a box ahead lengthens the ray to it by the same distance; limited ranges have gradient zero."""
    room = arena.empty_room((40.0, 40.0), boxes=arena.make_prisms([[1.5, 0.0]], 0.5, 1.0))
    jacobian = jax.jit(jax.jacrev(lambda position: laser.scan(PARAMS, room, position, jnp.eye(3))))
    rows = np.asarray(jacobian(jnp.asarray([0.0, 0.0, 0.2])))
    np.testing.assert_allclose(rows[170], [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(rows[0], 0.0)
    assert np.isfinite(rows).all()


def test_runs_in_either_precision(precision: str, strict: None) -> None:
    room = arena.empty_room((4.0, 4.0))
    scan = partial(laser.scan, laser.Params(rays=11))
    ranges = jax.eval_shape(scan, room, jnp.asarray([0.0, 0.0, 0.2]), jnp.eye(3))
    assert ranges.dtype == precision
    assert ranges.shape == (11,)


@pytest.mark.parametrize("wrong", [{"rays": 1}, {"fov": 0.0}, {"fov": 7.0}, {"max_range": float("nan")}])
def test_impossible_parameters_are_refused(wrong):
    laser.check(laser.Params())
    with pytest.raises(InputError, match=next(iter(wrong))):
        laser.check(laser.Params(**wrong))


def test_corridor_distances_equal_those_of_single_hits() -> None:
    """Of a box ahead to the left and a wall beside on the right."""
    room = arena.empty_room((8.0, 2.0), boxes=arena.make_prisms([[1.5, 0.3]], 0.2, 0.8))
    ranges = np.asarray(scan(room, jnp.asarray([0.0, 0.0, 0.2]), np.eye(3)))
    phi = np.deg2rad(np.linspace(-85.0, 85.0, 341))
    w, a = PARAMS.corridor_half_width, PARAMS.corridor_slope
    e = [min(r * np.cos(p) + a * max(abs(r * np.sin(p)) - w, 0), 5.0) for r, p in zip(ranges, phi, strict=True)]
    found = laser.corridor_distances(PARAMS, jnp.asarray(ranges))
    np.testing.assert_allclose(found, [min(e[170:]), min(e[:171])], atol=1e-9)
    nearest = laser.hemifield_distances(jnp.asarray(ranges))
    assert found[0] == pytest.approx(1.3, abs=0.01)  # the box's near face, which reaches 0.1 m beyond the middle
    assert nearest[1] < 1.01 < 1.3 < found[1]  # the wall is near, and not in the way


def test_an_impossible_corridor_is_refused() -> None:
    for params in (laser.Params(corridor_half_width=-0.1), laser.Params(corridor_slope=math.nan)):
        with pytest.raises(InputError, match=r"laser corridor_.*: expected a finite number >= 0"):
            laser.check(params)
