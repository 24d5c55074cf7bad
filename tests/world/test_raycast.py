"""Rays against C MuJoCo's, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import arena as reference

from lgmdjax.world import arena, raycast, scenes

ROOMS = {
    "training": scenes.training_room,
    "testing": scenes.testing_room,
    "tube": lambda: scenes.tube_scene(0.12),
    "indoor": scenes.indoor_scene,
    "outdoor": scenes.outdoor_scene,
    "dynamic": lambda: arena.at(scenes.dynamic_scene(), 11.0),
    "random": lambda: scenes.random_room(jax.random.key(3)),
}
cast = jax.jit(jax.vmap(raycast.distance, in_axes=(None, 0, 0)))


def rays(room: arena.Arena, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random origins below the walls' tops, some inside obstacles; directions mostly nearly level."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = np.asarray(room.room)
    low, high = (x_min, y_min, 0.0), (x_max, y_max, float(room.wall_height))
    origins = rng.uniform(low, high, (count, 3))
    directions = rng.normal(size=(count, 3)) * np.where(rng.random((count, 1)) < 0.6, [1.0, 1.0, 0.1], 1.0)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", ROOMS)
def test_every_ray_goes_as_far_as_mujocos(name: str) -> None:
    room = ROOMS[name]()
    origins, directions = rays(room, 10_000)
    ours = np.asarray(cast(room, origins, directions))
    theirs = reference.ray(*reference.load(reference.to_mjcf(room)), origins, directions)
    np.testing.assert_array_equal(np.isinf(ours), np.isinf(theirs))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)


def test_the_rays_of_the_comparison_meet_every_kind_of_surface() -> None:
    """Sides, tops, undersides and insides of both kinds; else equal distances would prove little."""
    room = scenes.outdoor_scene()
    origins, directions = rays(room, 10_000)
    each = jax.jit(
        jax.vmap(lambda o, d: (raycast.to_boxes(room.boxes, o, d), raycast.to_cylinders(room.cylinders, o, d)))
    )
    crowns = np.asarray(each(origins, directions)[1])[:, 5:10]
    from_below = (crowns < np.inf) & (origins[:, 2:] + crowns * directions[:, 2:] < 1.9 + 1e-9)
    assert from_below.any()
    for hits in each(origins, directions):
        assert (np.isfinite(np.asarray(hits)).sum(axis=0)[:2] > 20).all()


def test_single_precision_is_as_good(float32: None) -> None:
    room = scenes.training_room()
    origins, directions = rays(room, 10_000)
    ours = np.asarray(cast(room, origins.astype(np.float32), directions.astype(np.float32)))
    assert ours.dtype == np.float32
    theirs = reference.ray(*reference.load(reference.to_mjcf(room)), origins, directions)
    close = np.isclose(ours, theirs, rtol=0, atol=1e-4)
    # A ray that grazes an edge may pass on its other side.
    assert np.mean(close) > 0.9995


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ((1.0, 0.0, 0.0), 0.5),  # along an axis, onto a face
        ((0.0, 0.0, -1.0), 0.2),  # down
        ((0.0, 0.0, 1.0), np.inf),  # up into the sky
        ((0.0, 1.0, 0.0), 0.7),  # onto a cylinder's axis
        ((-2.0, 0.0, 0.0), 1.5),  # lengths of a direction that is not a unit one
    ],
)
def test_rays_along_the_axes_are_exact(direction: tuple[float, float, float], expected: float) -> None:
    room = arena.empty_room(boxes=arena.place([[1.0, 0.0]], 0.5, 1.0), cylinders=arena.place([[0.0, 1.0]], 0.3, 1.0))
    origin, direction_ = jnp.asarray([0.0, 0.0, 0.2]), jnp.asarray(direction)
    both = jax.jit(jax.value_and_grad(raycast.distance, argnums=(0, 1, 2)))
    far, derivatives = both(room, origin, direction_)
    assert float(far) == pytest.approx(expected, abs=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(derivatives))


def test_walls_are_seen_from_inside_only() -> None:
    room = arena.empty_room((6.0, 6.0), wall_height=2.0)
    outside, above = [-5.0, 0.0, 1.0], [0.0, 0.0, 2.5]
    forward = np.asarray([[1.0, 0.0, 0.0]] * 2)
    np.testing.assert_allclose(cast(room, np.asarray([outside, above]), forward), [8.0, np.inf])


def test_reverse_mode_equals_differences_and_is_finite_everywhere() -> None:
    room = scenes.training_room()
    origins, directions = rays(room, 300)

    def total(shift: jax.Array, room: arena.Arena) -> jax.Array:
        far = jax.vmap(lambda o, d: raycast.distance(room, o + shift, d))(origins, directions)
        return jnp.sum(jnp.where(jnp.isfinite(far), far, 0.0))

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    slope, of_room = both(jnp.zeros(3), room)[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(of_room))
    # No ray crosses an edge within 1e-7 m, so central differences see the same surfaces.
    for axis, step in enumerate(1e-7 * np.eye(3)):
        difference = (both(step, room)[0] - both(-step, room)[0]) / 2e-7
        np.testing.assert_allclose(slope[axis], difference, rtol=1e-5)


def capsules() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    starts = rng.uniform(-1.0, 1.0, (12, 3))
    ends = starts + rng.normal(scale=0.4, size=(12, 3))
    ends[:3] = starts[:3]
    return starts, ends, rng.uniform(0.05, 0.25, 12)


def test_rays_meet_capsules_and_spheres_where_mujocos_do() -> None:
    starts, ends, radii = capsules()
    shapes = []
    for start, end, radius in zip(starts, ends, radii, strict=True):
        p, q = (" ".join(repr(float(v)) for v in point) for point in (start, end))
        ball = (start == end).all()
        where = f'type="sphere" pos="{p}"' if ball else f'type="capsule" fromto="{p} {q}"'
        shapes.append(f'<geom {where} size="{float(radius)!r}"/>')
    model, data = reference.load(f"<mujoco><worldbody>{''.join(shapes)}</worldbody></mujoco>")
    rng = np.random.default_rng(6)
    outward = rng.normal(size=(4000, 3))
    origins = 4.0 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    directions = rng.uniform(-1.2, 1.2, (4000, 3)) - origins
    hits = jax.jit(jax.vmap(raycast.to_capsules, in_axes=(0, 0, None, None, None)))(
        origins, directions, starts, ends, radii
    )
    theirs = reference.ray(model, data, origins, directions)
    assert np.isfinite(theirs).mean() > 0.2
    assert (np.isfinite(hits).sum(axis=0) > 10).all()
    np.testing.assert_allclose(np.min(hits, axis=1), theirs, rtol=0, atol=1e-6)


def test_capsules_have_finite_derivatives() -> None:
    starts, ends, radii = capsules()
    along = (ends[4] - starts[4]) / np.linalg.norm(ends[4] - starts[4])
    # Down a capsule's axis, through a ball's middle, past everything.
    origins = jnp.asarray([starts[4] - 3.0 * along, starts[0] - [3.0, 0.0, 0.0], [0.0, 0.0, 9.0]])
    directions = jnp.asarray([along, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def total(origins: jax.Array, starts: jax.Array, ends: jax.Array) -> jax.Array:
        hits = jax.vmap(lambda o, d: raycast.to_capsules(o, d, starts, ends, jnp.asarray(radii)))(origins, directions)
        return jnp.sum(jnp.where(jnp.isfinite(hits), hits, 0.0))

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(origins, jnp.asarray(starts), jnp.asarray(ends))
    for slope in slopes:
        assert np.isfinite(slope).all()
        assert np.any(slope != 0)


def test_nothing_is_promoted(strict: None) -> None:
    room = arena.empty_room()
    points = jnp.ones((2, 3))
    jax.eval_shape(raycast.distance, room, points[0], points)
    jax.eval_shape(raycast.to_capsules, points[0], points, points, points, points[0, :2])
