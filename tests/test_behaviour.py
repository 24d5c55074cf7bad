"""The controller that comes with the package, in small versions of the paper's experiments: what it does, not how well.

One crowd walks once with the controller and once blind, in single precision as users do: every scene and its mirror
image side by side, so that one program serves all.
"""

import jax
import numpy as np
import pytest

from lgmdjax import arena, drivers, hexapod, rollout, scales, scenes, scores, simulation
from lgmdjax.stages import crew

SECONDS = 26.0
SCENES = {
    "tube": lambda key: scenes.tube_scene(0.12, key),
    "tube far to the left": lambda key: scenes.tube_scene(0.42, key),
    "indoor": scenes.indoor_scene,
    "outdoor": scenes.outdoor_scene,
    "dynamic": scenes.dynamic_scene,
}
IN_THE_WAY = ("tube", "indoor", "outdoor", "dynamic")


@pytest.fixture(scope="module")
def walks():
    """Walk every scene and its mirror image; axes (scene, as it is or mirrored, frame)."""
    with jax.enable_x64(False):
        robot = crew.with_eyes(crew.trained(), scales.Eyes(width=80, height=60, pooling=3))
        built = [scene(jax.random.key(7)) for scene in SCENES.values()]
        rooms = rollout.stack(
            [
                simulation.Room(arena=room, starts=jax.numpy.tile(room.start, (4, 1)), key=jax.random.key(0))
                for one in built
                for room in (one, arena.mirror(one))
            ]
        )
        model = hexapod.build()
        records = {}
        for driver in (drivers.LEARNED, drivers.BLIND):
            chunks = crew.walks(
                crew.seat(robot, driver), model, rooms, SECONDS, driver.name, draw=driver is drivers.LEARNED
            )
            record = rollout.together(list(chunks))
            records[driver.name] = jax.tree.map(lambda x: x.reshape(len(SCENES), 2, *x.shape[1:]), record)
    return records


def heading(record) -> np.ndarray:
    return np.unwrap(scores.yaws(record.quaternion), axis=-1)


def untouched(record) -> np.ndarray:
    """Whether each robot touched nothing; shape (scene, 2)."""
    return ~record.contact.any(axis=-1) & record.ok.all(axis=-1)


@pytest.mark.slow
def test_blind_robot_walks_into_what_is_in_its_way(walks):
    for name, free in zip(SCENES, untouched(walks["blind"]), strict=True):
        assert not free.any() if name in IN_THE_WAY else free.all(), name


def test_learned_controller_touches_nothing_that_a_blind_robot_walks_into(walks):
    learned = untouched(walks["learned"])
    assert learned.sum() >= learned.size - 1, dict(zip(SCENES, learned.tolist(), strict=True))


def test_turns_away_from_the_tube_on_its_side_and_mirrors_when_mirrored(walks):
    """Until it has turned by a radian, or for the whole walk: the tube stands to the left, mirrored to the right."""
    tube = list(SCENES).index("tube")
    turned = heading(walks["learned"])[tube]
    far = np.abs(turned) > 1.0
    end = [row.argmax() if row.any() else len(row) - 1 for row in far]
    assert turned[0, end[0]] < -0.2
    assert turned[1, end[1]] > 0.2


def test_passes_what_is_not_in_its_way(walks):
    """A tube far to the side is passed: the robot goes on, and turns no more than it must."""
    far = list(SCENES).index("tube far to the left")
    assert np.all(walks["learned"].position[far, :, -1, 0] > 0.6)


def test_turns_more_where_something_is_in_the_way(walks):
    turning = np.abs(np.diff(walks["learned"].velocity, axis=-1))[..., 0].mean(axis=-1)
    far, tube, indoor = (list(SCENES).index(name) for name in ("tube far to the left", "tube", "indoor"))
    assert turning[far].mean() < min(turning[tube].mean(), turning[indoor].mean())
