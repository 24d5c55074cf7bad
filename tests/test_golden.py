"""Studies in small: what becomes of the robot that comes along, and of pupils, when one thing about them is changed.

Robots walk for 20 s before boxes, in the testing room and into a corner, and in the mirror images of those. All that
changes is numbers, but for two errata: one program serves nearly all.
"""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import places
import pytest

from lgmdjax import apprentice, drivers, hexapod, rollout, scales, scenes, simulation
from lgmdjax.stages import crew
from lgmdjax.studies import printed, teaching

pytestmark = pytest.mark.usefixtures("float32")
SECONDS = 20.0
SCENES = (
    *(places.beside(jax.random.key(number), 0.35) for number in range(2)),
    places.in_the_testing_room(jax.random.key(7)),
    places.before_a_corner(jax.random.key(7)),
)


@pytest.fixture(scope="module")
def robot() -> simulation.Params:
    with jax.enable_x64(False):
        return crew.with_eyes(crew.trained(), scales.Eyes(width=80, height=60, pooling=3))


def walk(robot: simulation.Params, *, driver: drivers.Driver = drivers.LEARNED, contrast: float = 1.0):
    rooms = places.with_mirror_images([scenes.faded(scene, contrast) for scene in SCENES])
    return rollout.together(list(crew.walks(crew.seat(robot, driver), hexapod.build(), rooms, SECONDS, driver.name)))


def untouched(record: simulation.Record) -> int:
    """Count the robots, of eight, that touched nothing."""
    return int((~record.contact.any(axis=-1) & record.ok.all(axis=-1)).sum())


def pace(record: simulation.Record) -> float:
    """Tell how fast the robots are [m a frame]; a setback is a single step, which a median does not see."""
    return float(np.median(np.linalg.norm(np.diff(record.position[..., :2], axis=1), axis=-1), axis=1).mean())


@pytest.mark.slow
def test_bears_faint_textures_but_not_a_gate_that_shuts_while_it_turns(robot):
    """Sensitivity: a quarter of the contrast does no harm, a T_f of a tenth does as much as walking blind."""
    assert untouched(walk(robot)) >= 7
    assert untouched(walk(robot, contrast=0.25)) >= 7
    detector = robot.controller.lgmd
    shut = replace(detector, suppression=0.1 * detector.suppression)
    shy = walk(replace(robot, controller=replace(robot.controller, lgmd=shut)))
    assert untouched(shy) <= 3
    assert untouched(walk(robot, driver=drivers.BLIND)) <= 1


@pytest.mark.parametrize(("case", "most"), [("sec. 3.3: whole pictures", 3), ("eq. 16: gate", 3)])
def test_is_not_guided_by_eyes_as_printed(robot, case, most):
    """Both eyes say the same of whole pictures, and behind the printed gate they say nothing."""
    record = walk(printed.CASES[case](robot, Path()))
    assert untouched(record) <= most
    sides = np.corrcoef(record.u[..., 0].ravel(), record.u[..., 1].ravel())[0, 1] if record.u.std() > 0.01 else 1.0
    assert sides > 0.9


def test_walks_on_by_the_printed_coupling(robot):
    """W as printed changes how soon the legs fall into step, not how the robot is guided: it starts in step."""
    assert untouched(walk(printed.CASES["eqs. 1, 3: coupling W"](robot, Path()))) >= 7


def test_pupil_of_3b_is_slow_and_pupil_of_2a_is_not(robot, tmp_path):
    """Four minutes of each vehicle's own walks make an LSTM that has its pace (sec. 4.2)."""
    found = {}
    for rule in ("2a", "3b"):
        ruled = teaching.under(robot, rule)
        lesson = apprentice.lesson(tmp_path / rule, ruled, 2 * len(SCENES), 30.0, 0, {})
        pupil, _ = apprentice.learn(tmp_path / rule / "checkpoints", lesson, 40, 0)
        found[rule] = walk(crew.manned(ruled, pupil))
    assert pace(found["3b"]) < 0.6 * pace(found["2a"])
    assert untouched(found["3b"]) > untouched(found["2a"])
