"""The scanner: which way its rays go, how far, and whose side they count for."""

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


def turned(yaw: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    """Rotation of a site: yaw, then pitch with the nose down for positive angles."""
    c, s, p, q = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.array([[p, 0, q], [0, 1, 0], [-q, 0, p]])


def test_two_rays_a_degree_from_right_to_left() -> None:
    bearings = np.rad2deg(laser.bearings(PARAMS))
    assert len(bearings) == 341
    np.testing.assert_allclose([bearings[0], bearings[170], bearings[-1]], [-85.0, 0.0, 85.0], atol=1e-12)
    np.testing.assert_allclose(np.diff(bearings), 0.5, atol=1e-12)


def test_an_empty_room_is_measured_as_trigonometry_has_it() -> None:
    """From the middle of 8 x 6 m: walls at 4 m ahead and 3 m aside."""
    room = arena.empty_room((8.0, 6.0))
    phi = np.deg2rad(np.linspace(-85.0, 85.0, 341))
    expected = np.minimum(4.0 / np.cos(phi), 3.0 / np.maximum(np.abs(np.sin(phi)), 1e-9))
    np.testing.assert_allclose(scan(room, jnp.asarray([0.0, 0.0, 0.2]), np.eye(3)), expected, atol=1e-9)


def test_a_turned_and_pitched_scanner_sees_what_mujoco_sees() -> None:
    room = scenes.testing_room()
    position, rotation = np.array([0.4, 1.7, 0.16]), turned(yaw=-1.9, pitch=0.05)
    phi = np.deg2rad(np.linspace(-85.0, 85.0, 341))
    directions = np.stack([np.cos(phi), np.sin(phi), 0 * phi], axis=-1) @ rotation.T
    model, data = reference.load(reference.to_mjcf(room))
    expected = np.minimum(reference.ray(model, data, np.tile(position, (341, 1)), directions), 5.0)
    assert expected.min() < 2.0 < expected.max()
    np.testing.assert_allclose(scan(room, position, rotation), expected, atol=1e-6)


def test_far_things_are_clipped() -> None:
    ranges = scan(arena.empty_room((20.0, 20.0)), jnp.asarray([0.0, 0.0, 0.2]), np.eye(3))
    np.testing.assert_array_equal(ranges, 5.0)


def test_a_scanner_with_its_nose_down_sees_the_floor() -> None:
    ranges = scan(arena.empty_room((20.0, 20.0)), jnp.asarray([0.0, 0.0, 0.2]), turned(pitch=0.1))
    assert float(ranges[170]) == pytest.approx(0.2 / math.sin(0.1))


@pytest.mark.parametrize(("side", "near", "far"), [(1.0, 0, 1), (-1.0, 1, 0)])
def test_a_thing_on_one_side_counts_for_that_side(side: float, near: int, far: int) -> None:
    room = arena.empty_room((8.0, 8.0), cylinders=arena.place([[1.0, 0.8 * side]], 0.2, 1.0))
    distances = laser.hemifields(scan(room, jnp.asarray([0.0, 0.0, 0.2]), np.eye(3)))
    # No ray need meet the point that is nearest, but one passes within a quarter of a degree.
    assert float(distances[near]) == pytest.approx(math.hypot(1.0, 0.8) - 0.2, abs=1e-4)
    assert float(distances[far]) == pytest.approx(4.0 / math.cos(0.0), abs=1e-3)


def test_the_middle_ray_counts_for_both_sides() -> None:
    ranges = jnp.full(341, 5.0).at[170].set(1.0)
    np.testing.assert_array_equal(laser.hemifields(ranges), [1.0, 1.0])
    np.testing.assert_array_equal(laser.hemifields(ranges.at[171].set(0.5)), [0.5, 1.0])
    np.testing.assert_array_equal(laser.hemifields(ranges.at[169].set(0.5)), [1.0, 0.5])


def test_hemifields_keep_a_batch() -> None:
    ranges = np.random.default_rng(0).uniform(0.5, 5.0, (7, 3, 341))
    both = np.stack([ranges[..., 170:].min(-1), ranges[..., :171].min(-1)], axis=-1)
    np.testing.assert_array_equal(laser.hemifields(jnp.asarray(ranges)), both)


def test_mirrored_rooms_give_mirrored_scans() -> None:
    room = scenes.training_room()
    position, flip = np.array([0.3, 0.4, 0.2]), np.array([1.0, -1.0, 1.0])
    ranges = scan(room, position, turned(yaw=0.7))
    swapped = scan(arena.mirror(room), position * flip, turned(yaw=-0.7))
    np.testing.assert_allclose(ranges, swapped[::-1], atol=1e-9)


def test_the_rule_can_be_differentiated_through_the_scan() -> None:
    """Backing off from the box ahead lengthens the ray that meets it by as much; clipped rays do not care."""
    room = arena.empty_room((40.0, 40.0), boxes=arena.place([[1.5, 0.0]], 0.5, 1.0))
    slope = jax.jit(jax.jacrev(lambda position: laser.scan(PARAMS, room, position, jnp.eye(3))))
    rows = np.asarray(slope(jnp.asarray([0.0, 0.0, 0.2])))
    np.testing.assert_allclose(rows[170], [-1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(rows[0], 0.0)
    assert np.isfinite(rows).all()


def test_the_scan_follows_the_precision(precision: str, strict: None) -> None:
    room = arena.empty_room((4.0, 4.0))
    scan = partial(laser.scan, laser.Params(rays=11))
    ranges = jax.eval_shape(scan, room, jnp.asarray([0.0, 0.0, 0.2]), jnp.eye(3))
    assert ranges.dtype == precision
    assert ranges.shape == (11,)


@pytest.mark.parametrize("wrong", [{"rays": 1}, {"field_of_view": 0.0}, {"field_of_view": 7.0}, {"clip": float("nan")}])
def test_a_scanner_that_sees_nothing_is_refused(wrong):
    laser.check(laser.Params())
    with pytest.raises(InputError, match=next(iter(wrong))):
        laser.check(laser.Params(**wrong))
