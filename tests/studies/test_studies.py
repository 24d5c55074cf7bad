"""The studies: what they change, what they count, and their figures, on walks and rows made up."""

import json
import math
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic
from scipy.spatial.transform import Rotation
from slopes import Routes

from lgmdjax.body import hexapod
from lgmdjax.cli import study
from lgmdjax.control import braitenberg, policies
from lgmdjax.evaluation import metrics, trials
from lgmdjax.learning import gait_objective, lgmd_grid_search
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.pipeline import scales
from lgmdjax.pipeline.stages import STUDIES
from lgmdjax.reporting.figures import style
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies import errata, failure_modes, gait_gradient, gradient_horizon, sensitivity, supervision, velocity
from lgmdjax.studies.settings import FailureModesSettings
from lgmdjax.world import arena

EYES = CameraSettings(width=80, height=60, pooling=3)


@pytest.fixture(scope="module")
def robot():
    return assembly.with_eyes(assembly.trained(), EYES)


def leaves(params) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in found}


def test_every_study_has_settings_at_paper_scale_alone():
    for stage in STUDIES:
        assert stage.name in scales.SCALES["paper"]
        assert stage.name not in scales.SCALES["quick"] and stage.name not in scales.SCALES["smoke"]


def test_velocity_tells_obstructed_frames_from_free_ones():
    """u is 0.6 + noise where something is near and 0.5 + noise where nothing is, so d is 0.1 over the noise."""
    generator = np.random.default_rng(0)
    record = synthetic.walk(robots=4, frames=1500)
    distance = np.where(np.arange(1500) % 500 < 250, 0.4, 3.0)
    noise = np.repeat(generator.normal(0, 0.02, (4, 60, 1)), 25, axis=1)
    u = np.where(distance < 1, 0.6, 0.5)[None, :, None] + noise
    changed = replace(record, u=np.repeat(u, 2, axis=-1))
    row, effects = velocity.measure(1.5, changed, np.broadcast_to(distance, (4, 1500)), suppression=1.0)
    assert row.obstructed == pytest.approx(0.6, abs=0.01) and row.free == pytest.approx(0.5, abs=0.01)
    assert row.effect == pytest.approx(0.1 / row.spread, rel=0.15)
    assert row.low < row.effect < row.high and row.high - row.low < 0.2 * row.effect
    assert row.speed == pytest.approx(0.05, rel=0.1)  # what is left of the sway counts as way
    assert row.silenced == 0
    worse, one = replace(row, velocity=3.0, effect=0.9 * row.effect), replace(row, velocity=5.0, effect=math.nan)
    told = velocity.compared([(row, effects), (worse, 0.9 * effects), (one, np.full_like(effects, np.nan))])
    assert [each.as_good for each in told] == [True, False, False]
    noisy = effects + generator.normal(0, 0.1 * row.effect, len(effects))
    assert [each.as_good for each in velocity.compared([(worse, noisy), (row, effects)])] == [True, True]


def test_velocity_without_frames_of_both_kinds_has_no_effect_and_is_not_the_best():
    record = synthetic.walk(robots=2, frames=300)
    blank, effects = velocity.measure(0.1, record, np.full((2, 300), 3.0), suppression=1.0)
    assert velocity.compared([(blank, effects)]) == [blank]
    assert np.isnan(blank.effect) and np.isnan(blank.low) and blank.frames[0] == 0 < blank.frames[1]
    rows = [asdict(blank), asdict(blank) | {"velocity": 1.2, "effect": 0.4}]
    assert velocity.best(rows)["velocity"] == 1.2
    assert velocity.draw(rows).axes


def test_ahead_is_measured_in_a_sector_straight_ahead(robot):
    """A box whose face is 1 m before the laser, which is 0.1 m or so before the middle; at a right angle nothing."""
    boxes = arena.place([[1.5, 0.0]], [[0.25, 0.25]], 0.8)
    room = jax.tree.map(lambda leaf: leaf[None], arena.empty_room((6.0, 6.0), boxes=boxes))
    turned = np.array([[1.0, 0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])[None]
    record = synthetic.walk(1, 2, quaternion=turned, position=np.array([[[0.0, 0, 0.1], [0, 0, 0.1]]]))
    forward, aside = velocity.ahead(room, record)[0]
    at = float(hexapod.laser_pose(hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray(turned[0, 0])))[0][0])
    assert forward == pytest.approx(1.25 - at, abs=1e-3)
    assert aside > 2.0


def test_at_velocity_seats_a_blind_driver_of_that_velocity(robot):
    blind = velocity.at_velocity(robot, 2.5).controller.driver.drivers[2]
    np.testing.assert_allclose(blind.velocity, 2.5)


def test_under_a_rule_the_robot_is_labelled_and_driven_by_it(robot):
    ruled = supervision.under(robot, "2a")
    assert float(ruled.teacher.gain_3b) == 0 and float(ruled.controller.driver.drivers[0].gain_3b) == 0
    distances = jnp.asarray([0.4, 2.0])
    _, label = braitenberg.step(ruled.teacher, braitenberg.init(ruled.teacher), distances)
    vehicle = braitenberg.vehicle_2a(1 / distances, 1.2, 0.8)
    np.testing.assert_allclose(label, braitenberg.limit(ruled.teacher, vehicle), atol=1e-9)


def test_starts_of_a_case_are_pooled():
    rows = [
        {"driver": "learned", "rule": "2a", "variant": "lstm", "distance": 50.0, "collisions": n}
        | {"per_100_m": asdict(metrics.poisson_rate(n, 0.5))}
        for n in (1, 4)
    ]
    (pupil,) = supervision.pooled(rows).values()
    assert (pupil["starts"], pupil["distance"], pupil["collisions"], pupil["each"]) == (2, 100.0, 5, [2.0, 8.0])
    assert pupil["per_100_m"] == asdict(metrics.poisson_rate(5, 1.0))


def test_an_erratum_changes_one_thing(robot):
    before = leaves(robot)
    for name in ("eqs. 1, 3: coupling W", "eq. 22: rule alone"):
        after = leaves(errata.CASES[name](robot, Path()))
        changed = {path for path in before if not np.array_equal(before[path], after[path])}
        assert changed and all(
            ("coupling" in path) or ("full_turn" in path) or ("symmetry" in path) for path in changed
        )
    assert errata.CASES["eq. 16: gate"](robot, Path()).controller.lgmd.printed_gate
    assert errata.CASES["eq. 15: signed sum"](robot, Path()).controller.lgmd.printed_feed_forward
    assert errata.CASES["eqs. 1, 3: sign of w_fe"](robot, Path()).controller.cpg.printed_sign


def test_walls_are_papered_and_nothing_else():
    rooms = trials.draw_rooms("white", 3, 0)
    after = failure_modes.papered(rooms, 0.25)
    np.testing.assert_array_equal(after.arena.wall_texture[..., 1], 0.25)
    back = replace(after, arena=replace(after.arena, wall_texture=rooms.arena.wall_texture))
    jax.tree.map(np.testing.assert_array_equal, back.arena, rooms.arena)
    assert not np.any(rooms.arena.wall_texture[..., 1])


def test_every_axis_of_sensitivity_has_the_chosen_value_once(robot):
    chosen = sensitivity.settled(robot, EYES)
    values: dict[str, list[float]] = {}
    for axis, value, changed, contrast in sensitivity.changes(robot, EYES):
        values.setdefault(axis, []).append(value)
        if value == chosen[axis] and axis not in ("rate", "sway"):  # which say so by being left out
            assert contrast == 1.0
            jax.tree.map(np.testing.assert_array_equal, changed, robot)
    assert set(values) == set(chosen)
    for axis, some in values.items():
        assert some.count(chosen[axis]) == 1, axis


def test_lessons_are_of_the_minutes_and_rooms_asked_for():
    generator = np.random.default_rng(1)
    walks = []
    for room in range(16):
        record = vars(synthetic.walk(1, int(generator.integers(400, 900))))
        fields = {name: np.asarray(leaf)[0] for name, leaf in record.items()}
        walks.append(episodes.Walk(episode=0, robot=room, room=room, seed=0, **fields))
    whole = sum(len(stretch) for stretch in episodes.stretches(walks)) / 1800
    asked = list(sensitivity.lessons(walks, seed=0))
    for _, value, some in (lesson for lesson in asked if lesson[0] == "minutes"):
        assert sum(map(len, some)) / 1800 == pytest.approx(value, abs=0.01)
        assert value <= whole + 1e-9
    rooms = [(value, some) for axis, value, some in asked if axis == "rooms"]
    assert [value for value, _ in rooms] == [8, 16]
    for value, some in rooms:
        assert len({walk.room for walk in some}) == value
        assert sum(map(len, some)) == pytest.approx(sum(map(len, rooms[0][1])), abs=2 * value)


def test_fits_to_less_take_as_many_steps_up_to_a_bound():
    assert sensitivity.fair(30, 8000, 8000) == 30
    assert sensitivity.fair(30, 8000, 2000) == 120
    assert sensitivity.fair(30, 8000, 10) == 30 * sensitivity.LONGEST


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 3.0])
def test_swaying_scales_the_tilt_and_keeps_the_heading(factor):
    """The tilt is what is left of a rotation when the heading is taken off (SciPy)."""
    for yaw, roll, pitch in ((0.3, 0.05, -0.1), (-2.5, -0.2, 0.02), (3.0, 0.0, 0.1)):
        heading = Rotation.from_euler("z", yaw)
        tilt = Rotation.from_rotvec([roll, pitch, 0.0])
        before = (heading * tilt).as_quat(scalar_first=True)
        pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray(before))
        after = hexapod.swaying(pose, jnp.asarray(factor)).quaternion
        expected = heading * Rotation.from_rotvec([factor * roll, factor * pitch, 0.0])
        turned = Rotation.from_quat(np.asarray(after), scalar_first=True)
        assert (turned * expected.inv()).magnitude() < 1e-7


def test_a_level_head_does_not_sway():
    pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray([np.cos(0.4), 0.0, 0.0, np.sin(0.4)]))
    np.testing.assert_allclose(hexapod.swaying(pose, jnp.asarray(3.0)).quaternion, pose.quaternion, atol=1e-12)


def test_follow_agrees_with_correlation_of_what_was_recorded():
    generator = np.random.default_rng(2)
    distances = 1.0 + 0.5 * np.sin(np.arange(1200)[None, :, None] / 60 + np.array([0.0, 2.0]))
    u = 0.5 + 0.05 / distances + np.repeat(generator.normal(0, 0.004, (1, 1200, 1)), 2, axis=-1)
    found = lgmd_grid_search.follow(replace(synthetic.walk(1, 1200), u=u, distances=distances))
    assert found["score"] > 0.99  # the noise is the same in both eyes
    assert 0.8 < found["left"] < found["score"]


def test_a_study_can_be_started_alone(tmp_path, monkeypatch):
    """With walks made up: a few centimetres straight on, where nobody turns back and nobody touches anything."""
    monkeypatch.setattr(
        recording, "walked", lambda folder, params, rooms, *_, **__: synthetic.walk(len(rooms.starts), 60)
    )
    bench = BenchmarkRooms(eyes=EYES, robots=2, seconds=2.0)
    study.command("failure_modes")(FailureModesSettings(bench=bench), out=tmp_path)
    folder = tmp_path / "failure_modes-0" / "failure_modes"
    rows = json.loads((folder / "failure_modes.json").read_text())
    assert len({(row["place"], row["contrast"], row["driver"]) for row in rows}) == len(rows) == 13
    assert all((row["robots"], row["untouched"], row["retreated"]) == (2, 2, 0) for row in rows)
    assert (folder / "failure_modes.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "study",
    [velocity, supervision, errata, failure_modes, sensitivity, gait_gradient, gradient_horizon],
    ids=lambda study: study.__name__,
)
def test_figures_can_be_drawn(study):
    rows = synthetic.rows_of(study.__name__.rpartition(".")[2])
    figure = study.draw(rows)
    assert style.to_svg(figure) == style.to_svg(study.draw(rows))
    assert any(axes.lines or axes.patches for axes in figure.axes)


def test_between_two_pictures_u_stands(robot):
    """With a picture every third frame u changes with every third frame only, and is that of the pictures."""
    room = room_batches.rooms_of(0, 0, 1)
    room = jax.tree.map(lambda leaf: leaf[0], room)
    model = hexapod.build()
    slow = assembly.with_eyes(robot, CameraSettings(width=16, height=12))
    slow = replace(slow, every=jnp.asarray(3, jnp.int32))
    state = closed_loop.init(slow, model, room, policies.ANYONE)
    look = jax.jit(lambda state: closed_loop.sense(slow, room.arena, state)[0])
    seen = []
    for frame in range(7):
        state = replace(state, frame=jnp.asarray(frame, jnp.int32), fresh=jnp.asarray(frame == 0))
        moved = replace(state.data, qpos=state.data.qpos.at[0].add(0.01))
        state = look(replace(state, data=moved))
        seen.append(np.asarray(state.response.u))
    changed = [bool(np.any(before != after)) for before, after in pairwise(seen)]
    assert changed == [False, False, True, False, False, True]


def test_fitted_legs_start_as_those_that_come_along_and_walk_mirrored():
    """Turning the rhythm by half a cycle and exchanging the sides' velocities mirrors the targets."""
    legs = gait_objective.before(shaping.taught())
    rhythm, networks = gait_objective.parts(legs)
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-6), (rhythm, networks), (cpg.Params(), shaping.taught()))
    changed = replace(
        legs,
        networks=jax.tree.map(
            lambda leaf: leaf + 0.1 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), legs.networks
        ),
    )
    networks = gait_objective.parts(changed)[1]
    signal = jnp.asarray(np.random.default_rng(3).normal(size=(6, 2)))
    there = shaping.shape(networks, signal, jnp.asarray([1.3, 0.4]))
    mirrored = shaping.shape(networks, signal[::-1], jnp.asarray([0.4, 1.3]))
    np.testing.assert_allclose(mirrored, there[::-1] * np.array([-1.0, 1.0, 1.0]), atol=1e-12)


@pytest.mark.slow
def test_a_window_has_one_derivative_by_three_routes():
    """Of all that it is measured by, from the middle of a step: by networks, cycle time and couplings."""
    legs, model = gait_objective.before(shaping.taught()), hexapod.softened(hexapod.build())
    walker, velocity = jax.jit(gait_objective.start)(legs, model, 0.15), jnp.asarray([1.2, 0.8])

    def measured(legs):
        course, _ = gait_objective.walk(legs, model, walker, velocity, 24)
        return 20 * course.speed + course.turn + course.sway + course.effort

    routes = Routes(measured)
    routes.assert_agree(legs)
    routes.assert_every_leaf_agrees(legs)


def test_evolution_estimates_the_slope_that_reverse_mode_takes():
    """Of quadratic losses of four robots, from many pairs; a robot whose loss is not finite does not count."""
    start = {"a": jnp.asarray([0.3, -0.2, 1.0]), "b": jnp.asarray(0.5)}
    goals = jnp.asarray([1.0, 0.5, 1.5, jnp.nan])

    def loss(params, goal):
        return jnp.sum((params["a"] - goal) ** 2) + 3 * params["b"] ** 2, 2 * goal

    settings = replace(scales.GRADIENTS["gait_gradient"], pairs=20000)
    value, exact, ends = gait_gradient.METHODS["gradient"](loss, settings)(start, goals, jax.random.key(0))
    tried, estimate, same = gait_gradient.METHODS["evolution"](loss, settings)(start, goals, jax.random.key(0))
    np.testing.assert_allclose(exact["a"], 2 * (start["a"] - 1))
    np.testing.assert_allclose(ends, 2 * goals)
    np.testing.assert_allclose(same, 2 * goals)
    assert tried == pytest.approx(float(value), rel=0.01)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=0.15), estimate, exact)


def test_a_window_is_measured_whatever_the_phase_of_its_gait():
    """A robot that goes along a heading of 0.5 rad with a speed that swings by half, and turns at 0.1 rad/s."""
    speed, turn, cycle, steps = 0.05, 0.1, 0.8, 288
    measured = []
    for phase in (0.0, 1.3, 2.9):
        time = np.arange(steps + 1) / 180
        swing = 4 * np.pi / cycle  # twice a cycle
        along = speed * (time - 0.5 / swing * np.cos(swing * time + phase))
        yaw = 0.5 + turn * (time - time[-1] / 2) + 0.02 * np.sin(swing / 2 * time + phase)
        way = np.stack([along * np.cos(0.5), along * np.sin(0.5)], axis=1)
        tilt = 0.01 * np.stack([np.sin(swing * time[1:]), np.cos(swing * time[1:])], axis=1)
        course = gait_objective.measured(*map(jnp.asarray, (way, yaw, tilt, np.full((steps, 18), 0.3))))
        measured.append((float(course.speed), float(course.turn), float(course.sway), float(course.effort)))
    np.testing.assert_allclose(measured, [(speed, turn, 0.01, 0.3)] * 3, rtol=0.02)
