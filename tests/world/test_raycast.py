"""Ray casting equals that of C MuJoCo, and its derivatives equal central differences."""

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
    "dynamic": lambda: arena.at_time(scenes.dynamic_scene(), 11.0),
    "random": lambda: scenes.random_room(jax.random.key(3)),
}
cast = jax.jit(jax.vmap(raycast.distance, in_axes=(None, 0, 0)))


def rays(room: arena.Arena, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Sample origins below the tops of the walls, some inside obstacles, and directions, most of them nearly level."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = np.asarray(room.bounds)
    low, high = (x_min, y_min, 0.0), (x_max, y_max, float(room.wall_height))
    origins = rng.uniform(low, high, (count, 3))
    directions = rng.normal(size=(count, 3)) * np.where(rng.random((count, 1)) < 0.6, [1.0, 1.0, 0.1], 1.0)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", ROOMS)
def test_distances_equal_those_of_mujoco(name: str) -> None:
    room = ROOMS[name]()
    origins, directions = rays(room, 10_000)
    ours = np.asarray(cast(room, origins, directions))
    theirs = reference.ray(*reference.load(reference.to_mjcf(room)), origins, directions)
    np.testing.assert_array_equal(np.isinf(ours), np.isinf(theirs))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)


def test_compared_rays_hit_every_kind_of_surface() -> None:
    """Sides, tops, undersides and insides of boxes and cylinders; otherwise equal distances would prove little."""
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


def test_single_precision_is_as_accurate(float32: None) -> None:
    room = scenes.training_room()
    origins, directions = rays(room, 10_000)
    ours = np.asarray(cast(room, origins.astype(np.float32), directions.astype(np.float32)))
    assert ours.dtype == np.float32
    theirs = reference.ray(*reference.load(reference.to_mjcf(room)), origins, directions)
    is_close = np.isclose(ours, theirs, rtol=0, atol=1e-4)
    # A ray that grazes an edge may pass on the other side of it.
    assert np.mean(is_close) > 0.9995


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ((1.0, 0.0, 0.0), 0.5),  # along an axis, onto a face
        ((0.0, 0.0, -1.0), 0.2),  # down
        ((0.0, 0.0, 1.0), np.inf),  # up into the sky
        ((0.0, 1.0, 0.0), 0.7),  # onto a cylinder's axis
        ((-2.0, 0.0, 0.0), 1.5),  # in lengths of a direction that is not a unit vector
    ],
)
def test_rays_along_the_axes_are_exact(direction: tuple[float, float, float], expected: float) -> None:
    room = arena.empty_room(
        boxes=arena.make_prisms([[1.0, 0.0]], 0.5, 1.0), cylinders=arena.make_prisms([[0.0, 1.0]], 0.3, 1.0)
    )
    value_and_grad = jax.jit(jax.value_and_grad(raycast.distance, argnums=(0, 1, 2)))
    distance, gradients = value_and_grad(room, jnp.asarray([0.0, 0.0, 0.2]), jnp.asarray(direction))
    assert float(distance) == pytest.approx(expected, abs=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


def test_walls_are_visible_from_inside_only() -> None:
    room = arena.empty_room((6.0, 6.0), wall_height=2.0)
    outside, above = [-5.0, 0.0, 1.0], [0.0, 0.0, 2.5]
    forward = np.asarray([[1.0, 0.0, 0.0]] * 2)
    np.testing.assert_allclose(cast(room, np.asarray([outside, above]), forward), [8.0, np.inf])


def test_gradient_equals_central_differences_and_is_finite() -> None:
    room = scenes.training_room()
    origins, directions = rays(room, 300)

    def total(shift: jax.Array, room: arena.Arena) -> jax.Array:
        distances = jax.vmap(lambda o, d: raycast.distance(room, o + shift, d))(origins, directions)
        return jnp.sum(jnp.where(jnp.isfinite(distances), distances, 0.0))

    value_and_grad = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    shift_gradient, room_gradient = value_and_grad(jnp.zeros(3), room)[1]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(room_gradient))
    # No ray crosses an edge within 1e-7 m, so that both ends of a difference hit the same surfaces.
    for axis, step in enumerate(1e-7 * np.eye(3)):
        difference = (value_and_grad(step, room)[0] - value_and_grad(-step, room)[0]) / 2e-7
        np.testing.assert_allclose(shift_gradient[axis], difference, rtol=1e-5)


def capsules() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample ends and radii of twelve capsules, three of them spheres."""
    rng = np.random.default_rng(5)
    starts = rng.uniform(-1.0, 1.0, (12, 3))
    ends = starts + rng.normal(scale=0.4, size=(12, 3))
    ends[:3] = starts[:3]
    return starts, ends, rng.uniform(0.05, 0.25, 12)


def test_distances_to_capsules_and_spheres_equal_those_of_mujoco() -> None:
    starts, ends, radii = capsules()
    shapes = []
    for start, end, radius in zip(starts, ends, radii, strict=True):
        p, q = (" ".join(repr(float(v)) for v in point) for point in (start, end))
        is_sphere = (start == end).all()
        where = f'type="sphere" pos="{p}"' if is_sphere else f'type="capsule" fromto="{p} {q}"'
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


def test_gradients_of_distances_to_capsules_are_finite() -> None:
    starts, ends, radii = capsules()
    along = (ends[4] - starts[4]) / np.linalg.norm(ends[4] - starts[4])
    # Along the axis of a capsule, through the centre of a sphere, and past all of them.
    origins = jnp.asarray([starts[4] - 3.0 * along, starts[0] - [3.0, 0.0, 0.0], [0.0, 0.0, 9.0]])
    directions = jnp.asarray([along, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def total(origins: jax.Array, starts: jax.Array, ends: jax.Array) -> jax.Array:
        hits = jax.vmap(lambda o, d: raycast.to_capsules(o, d, starts, ends, jnp.asarray(radii)))(origins, directions)
        return jnp.sum(jnp.where(jnp.isfinite(hits), hits, 0.0))

    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(origins, jnp.asarray(starts), jnp.asarray(ends))
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert np.any(gradient != 0)


def test_no_dtype_is_promoted(strict: None) -> None:
    room = arena.empty_room()
    points = jnp.ones((2, 3))
    jax.eval_shape(raycast.distance, room, points[0], points)
    jax.eval_shape(raycast.to_capsules, points[0], points, points, points, points[0, :2])
