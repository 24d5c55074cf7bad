"""Small versions of the studies, with statements that hold on any machine.

Where vision does not affect the walk (policy `blind`), one recorded walk shows all cameras and detectors the same
motion, so that their responses can be compared frame by frame.
"""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import small_rooms

from lgmdjax.detectors import lgmd
from lgmdjax.learning.settings import TrainSettings
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, recording, rerender, rollout
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies import errata, supervision
from lgmdjax.studies.settings import SupervisionSettings
from lgmdjax.world import scenes

pytestmark = [pytest.mark.optimised, pytest.mark.usefixtures("float32")]
EYES = CameraSettings(width=80, height=60, pooling=3, ground=0.5, falloff=2.0)  # of the pretrained robot
SECONDS = 4.0


@pytest.fixture(scope="module")
def robot() -> closed_loop.Params:
    with jax.enable_x64(False):
        return assembly.with_camera(assembly.load_robot(), EYES)


@pytest.fixture(scope="module")
def rooms() -> closed_loop.Room:
    """Rooms with a box ahead, with many obstacles, and with a corner ahead, each beside its mirror image."""
    with jax.enable_x64(False):
        built = [
            small_rooms.box_ahead(jax.random.key(0), 0.35),
            small_rooms.testing_room_near_box(jax.random.key(7)),
            small_rooms.facing_corner(jax.random.key(7)),
        ]
        return small_rooms.with_mirror_images(built)


def walk_blindly(robot: closed_loop.Params, rooms: closed_loop.Room) -> closed_loop.Record:
    """In batches of four, whose program the smoke run has compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "BATCH_SIZES", (4,))
        return recording.rollout(robot, rooms, seconds=SECONDS, policy="blind", render=False)


@pytest.fixture(scope="module")
def walks(robot, rooms) -> closed_loop.Record:
    with jax.enable_x64(False):
        return walk_blindly(robot, rooms)


def respond(robot: closed_loop.Params, rooms: closed_loop.Room, walks: closed_loop.Record) -> lgmd.Response:
    """Render walks for a robot's detectors and return their responses, axes (robot, eye, frame)."""
    detector = robot.controller.detector
    pictures = rerender.render_walks(robot.camera, rooms.arena, walks)

    def eye(pictures: jax.Array) -> lgmd.Response:
        return jax.lax.scan(partial(lgmd.step, detector), lgmd.init(detector, pictures[0]), pictures)[1]

    return jax.device_get(jax.jit(jax.vmap(jax.vmap(eye, in_axes=1)))(pictures))


@pytest.fixture(scope="module")
def unchanged(robot, rooms, walks) -> lgmd.Response:
    with jax.enable_x64(False):
        return respond(robot, rooms, walks)


def with_lgmd(robot: closed_loop.Params, **changes) -> closed_loop.Params:
    return replace(robot, controller=replace(robot.controller, detector=replace(robot.controller.detector, **changes)))


def test_low_contrast_lowers_the_excitation(robot, rooms, walks, unchanged):
    faint = replace(rooms, arena=jax.vmap(lambda arena: scenes.scale_contrast(arena, 0.25))(rooms.arena))
    excitation = respond(robot, faint, walks).excitation.mean(axis=(1, 2))
    assert np.all(excitation < unchanged.excitation.mean(axis=(1, 2)))


def test_low_T_f_suppresses_u_in_exactly_the_frames_above_it(robot, rooms, walks, unchanged):
    T_f = float(np.median(unchanged.feed_forward))
    u = respond(with_lgmd(robot, suppression=jax.numpy.asarray(T_f)), rooms, walks).u
    suppressed = unchanged.feed_forward > T_f
    assert 0.4 < suppressed.mean() < 0.6
    np.testing.assert_array_equal(u, np.where(suppressed, lgmd.U_AT_REST, unchanged.u))


def test_printed_gate_passes_u_above_T_f_only(robot, rooms, walks, unchanged):
    """Eq. 16 as printed is the negation of the corrected gate; a walking robot never exceeds T_f."""
    printed = errata.CASES["eq. 16: gate"](robot, Path())
    below = unchanged.feed_forward <= float(robot.controller.detector.suppression)
    assert below.mean() > 0.9
    np.testing.assert_array_equal(respond(printed, rooms, walks).u[below], lgmd.U_AT_REST)


def test_whole_pictures_make_the_detectors_respond_alike(robot, rooms, walks, unchanged):
    """Sec. 3.3: with the whole picture each, both detectors see nearly the same."""
    whole = robot
    for part in ("whole width", "with the ground", "equal weights"):
        whole = errata.CASES[f"sec. 3.3: {part}"](whole, Path())

    def correlation(response: lgmd.Response) -> float:
        return float(np.corrcoef(response.u[:, 0].ravel(), response.u[:, 1].ravel())[0, 1])

    assert correlation(respond(whole, rooms, walks)) > correlation(unchanged)


def test_printed_coupling_changes_the_steps_but_not_the_direction(robot, rooms, walks):
    """W as printed gives other phases of the legs; the robot still walks forward."""
    changed = walk_blindly(errata.CASES["eqs. 1, 3: coupling W"](robot, Path()), rooms)
    assert np.abs(changed.joints - walks.joints).max() > 0.01
    assert np.all(np.isfinite(changed.position)) and changed.ok.all()
    ahead = walks.position[:, -1, :2] - walks.position[:, 0, :2]
    progress = np.sum(ahead * (changed.position[:, -1, :2] - changed.position[:, 0, :2]), axis=1)
    assert np.all(progress > 0)


@pytest.mark.slow
def test_supervision_study_trains_and_scores_every_case(tmp_path, monkeypatch):
    """From end to end with two cases; a second run reads all walks and fits, and gives the same rows."""
    monkeypatch.setattr(supervision, "CASES", (supervision.CASES[0], supervision.CASES[1]))
    eyes = EYES  # whose programs the smoke run has compiled
    settings = SupervisionSettings(
        benchmark=BenchmarkRooms(eyes=eyes, robots=4, seconds=5.0),
        dagger=TrainSettings(eyes=eyes, epochs=1, dagger_rounds=1, round_epochs=1, robots=4, round_seconds=5.0),
        demonstration_seconds=5.0,
        seeds=1,
    )
    inputs = {"fit-gait": PRETRAINED_DIR, "train": PRETRAINED_DIR}
    supervision.run(tmp_path, inputs, settings, 0)
    rows = json.loads((tmp_path / "supervision.json").read_text())
    assert [(row["policy"], row["rule"], row.get("variant"), row.get("repeat")) for row in rows] == [
        *(("teacher", rule, None, None) for rule in supervision.RULES),
        ("direct", "teacher", None, None),
        ("learned", "2a", "lstm", 0),
        ("learned", "3b", "lstm", 0),
    ]
    for row in rows:
        assert row["robots"] == 4 and row["collisions"] >= 0
        assert 0 < row["distance"] < 4 * 5.0 * 0.2 and 0 < row["speed"] < 0.2  # m, m/s: 0.1 m/s is the fastest command
        rate = row["per_100_m"]
        assert 0 <= rate["low"] <= rate["value"] <= rate["high"]
    monkeypatch.setattr(rollout, "rollout_chunks", lambda *_, **__: pytest.fail("a walk was recorded again"))
    supervision.run(tmp_path, inputs, settings, 0)
    assert json.loads((tmp_path / "supervision.json").read_text()) == rows
