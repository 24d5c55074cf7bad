"""Studies in small: what becomes of the robot that comes along, and of pupils, when one thing about them is changed.

Robots walk for 20 s before boxes, in the testing room and into a corner, and in the mirror images of those. Nearly all
that changes is numbers, for which one program serves.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import places
import pytest

from lgmdjax.body import hexapod
from lgmdjax.control import policies
from lgmdjax.learning import dagger
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording, rollout
from lgmdjax.studies import errata, supervision
from lgmdjax.world import scenes

pytestmark = pytest.mark.usefixtures("float32")
SECONDS = 20.0
Walk = Callable[..., closed_loop.Record]


@pytest.fixture(scope="module")
def robot() -> closed_loop.Params:
    with jax.enable_x64(False):
        return assembly.with_eyes(assembly.trained(), CameraSettings(width=80, height=60, pooling=3))


@pytest.fixture(scope="module")
def walk() -> Walk:
    """Put eight robots into the scenes, which are built in single precision, and let one of the drivers drive."""
    with jax.enable_x64(False):
        built = [places.beside(jax.random.key(number), 0.35) for number in range(2)]
        built += [scene(jax.random.key(7)) for scene in (places.in_the_testing_room, places.before_a_corner)]

    def walk(robot: closed_loop.Params, *, driver: policies.Driver = policies.LEARNED, contrast: float = 1.0):
        rooms = places.with_mirror_images([scenes.faded(scene, contrast) for scene in built])
        assert rooms.starts.dtype == np.float32
        return rollout.together(
            list(recording.walks(assembly.seat(robot, driver), hexapod.build(), rooms, SECONDS, driver.name))
        )

    return walk


@pytest.fixture(scope="module")
def unchanged(robot, walk) -> closed_loop.Record:
    with jax.enable_x64(False):
        return walk(robot)


def untouched(record: closed_loop.Record) -> int:
    """Count the robots, of eight, that touched nothing."""
    return int((~record.contact.any(axis=-1) & record.ok.all(axis=-1)).sum())


def pace(record: closed_loop.Record) -> float:
    """Tell how fast the robots are [m a frame]; a setback is a single step, which a median does not see."""
    return float(np.median(np.linalg.norm(np.diff(record.position[..., :2], axis=1), axis=-1), axis=1).mean())


@pytest.mark.slow
def test_bears_faint_textures_but_not_a_gate_that_shuts_while_it_turns(robot, walk, unchanged):
    """Sensitivity: a quarter of the contrast does no harm, a T_f of a tenth does as much as walking blind."""
    assert untouched(unchanged) >= 7
    assert untouched(walk(robot, contrast=0.25)) >= 7
    detector = robot.controller.lgmd
    shut = replace(detector, suppression=0.1 * detector.suppression)
    assert untouched(walk(replace(robot, controller=replace(robot.controller, lgmd=shut)))) <= 3
    assert untouched(walk(robot, driver=policies.BLIND)) <= 1


def test_says_nothing_through_the_printed_gate_and_walks_into_things(robot, walk):
    """Eq. 16 as printed lets u pass while the picture moves fast, which it never does as fast as T_f."""
    record = walk(errata.CASES["eq. 16: gate"](robot, Path()))
    assert record.u.std() < 0.01
    assert untouched(record) <= 3


def test_is_not_guided_by_whole_pictures(robot, walk, unchanged):
    """Sec. 3.3: shown all that its eye sees, either detector says what the other does."""
    record = walk(errata.CASES["sec. 3.3: whole pictures"](robot, Path()))
    assert alike(record) > 0.9 > alike(unchanged)
    assert untouched(record) <= 3


def alike(record: closed_loop.Record) -> float:
    """Correlate what the two eyes say."""
    return float(np.corrcoef(record.u[..., 0].ravel(), record.u[..., 1].ravel())[0, 1])


def test_is_guided_as_well_by_the_printed_coupling(robot, walk, unchanged):
    """W as printed changes how soon the legs fall into step, and they start in it: other steps, the same way."""
    record = walk(errata.CASES["eqs. 1, 3: coupling W"](robot, Path()))
    assert np.abs(record.joints - unchanged.joints).max() > 0.01
    assert untouched(record) >= 7


def test_pupil_of_3b_gets_on_more_slowly_than_pupil_of_2a(robot, walk, tmp_path):
    """Four minutes of walks by either vehicle alone make LSTMs that differ as the vehicles do (sec. 4.2)."""
    found = {}
    for rule in ("2a", "3b"):
        ruled = supervision.under(robot, rule)
        lesson = dagger.lesson(tmp_path / rule, ruled, 8, 30.0, 0, {})
        pupil, _ = dagger.learn(tmp_path / rule / "checkpoints", lesson, 40, 0)
        found[rule] = walk(assembly.manned(ruled, pupil))
    assert pace(found["3b"]) < 0.6 * pace(found["2a"])
    assert untouched(found["2a"]) < 8
