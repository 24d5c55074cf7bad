"""The studies: what they change and count, and their figures, on synthetic walks and rows."""

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
from derivatives import DerivativeCheck
from scipy.spatial.transform import Rotation

from lgmdjax.body import hexapod
from lgmdjax.cli import flags, study
from lgmdjax.control import braitenberg, policies
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, trials
from lgmdjax.learning import gait_objective, lgmd_grid_search
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.pipeline import scales
from lgmdjax.pipeline.stages import STUDIES
from lgmdjax.reporting.figures import style
from lgmdjax.sensors.settings import CameraSettings
from lgmdjax.simulation import assembly, closed_loop, episodes, recording, room_batches
from lgmdjax.simulation.settings import BenchmarkRooms
from lgmdjax.studies import (
    errata,
    failure_modes,
    gait_gradient,
    gradient_horizon,
    overlap,
    sensitivity,
    supervision,
    velocity,
)
from lgmdjax.studies.settings import FailureModesSettings, GaitGradientSettings, OverlapSettings
from lgmdjax.world import arena

EYES = CameraSettings(width=80, height=60, pooling=3, ground=0.5, falloff=2.0)  # of the pretrained robot


@pytest.fixture(scope="module")
def robot():
    return assembly.with_camera(assembly.load_robot(), EYES)


def leaves(params) -> dict[str, np.ndarray]:
    found = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in found}


def test_studies_that_are_stages_have_settings_at_scale_paper_only():
    for stage in STUDIES:
        assert stage.name in scales.SCALES["paper"]
        assert stage.name not in scales.SCALES["quick"] and stage.name not in scales.SCALES["smoke"]


def test_every_study_has_a_preset():
    presets = {*scales.SCALES["paper"], *scales.STUDY_PRESETS}
    assert set(study.MODULES) <= presets


def test_velocity_compares_obstructed_with_free_frames():
    """u is 0.6 + noise in obstructed frames and 0.5 + noise in free ones, so d is 0.1 over the noise."""
    generator = np.random.default_rng(0)
    record = synthetic.walk(robots=4, frames=1500)
    distance = np.where(np.arange(1500) % 500 < 250, 0.4, 3.0)
    noise = np.repeat(generator.normal(0, 0.02, (4, 60, 1)), 25, axis=1)
    u = np.where(distance < 1, 0.6, 0.5)[None, :, None] + noise
    changed = replace(record, u=np.repeat(u, 2, axis=-1))
    row, effects = velocity.score_velocity(1.5, changed, np.broadcast_to(distance, (4, 1500)), suppression=1.0)
    assert row.obstructed == pytest.approx(0.6, abs=0.01) and row.free == pytest.approx(0.5, abs=0.01)
    assert row.effect == pytest.approx(0.1 / row.spread, rel=0.15)
    assert row.low < row.effect < row.high and row.high - row.low < 0.2 * row.effect
    assert row.speed == pytest.approx(0.05, rel=0.1)  # the rest of the sway adds to the path
    assert row.suppressed == 0
    worse, one = replace(row, velocity=3.0, effect=0.9 * row.effect), replace(row, velocity=5.0, effect=math.nan)
    marked = velocity.mark_best([(row, effects), (worse, 0.9 * effects), (one, np.full_like(effects, np.nan))])
    assert [each.as_good for each in marked] == [True, False, False]
    noisy = effects + generator.normal(0, 0.1 * row.effect, len(effects))
    assert [each.as_good for each in velocity.mark_best([(worse, noisy), (row, effects)])] == [True, True]


def test_velocity_without_frames_of_both_kinds_has_no_effect_size_and_is_not_best():
    record = synthetic.walk(robots=2, frames=300)
    blank, effects = velocity.score_velocity(0.1, record, np.full((2, 300), 3.0), suppression=1.0)
    assert velocity.mark_best([(blank, effects)]) == [blank]
    assert np.isnan(blank.effect) and np.isnan(blank.low) and blank.frames[0] == 0 < blank.frames[1]
    rows = [asdict(blank), asdict(blank) | {"velocity": 1.2, "effect": 0.4}]
    assert velocity.best_row(rows)["velocity"] == 1.2
    assert velocity.plot(rows).axes


def test_distance_ahead_is_measured_in_a_sector_straight_ahead():
    """A box with its face 1.25 m ahead of the trunk; after a turn by a right angle nothing is near."""
    boxes = arena.make_prisms([[1.5, 0.0]], [[0.25, 0.25]], 0.8)
    room = jax.tree.map(lambda leaf: leaf[None], arena.empty_room((6.0, 6.0), boxes=boxes))
    turned = np.array([[1.0, 0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])[None]
    record = synthetic.walk(1, 2, quaternion=turned, position=np.array([[[0.0, 0, 0.1], [0, 0, 0.1]]]))
    ahead, aside = velocity.distance_ahead(room, record)[0]
    at = float(hexapod.laser_pose(hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray(turned[0, 0])))[0][0])
    assert ahead == pytest.approx(1.25 - at, abs=1e-3)
    assert aside > 2.0


def test_with_velocity_sets_the_velocity_of_the_policy_blind(robot):
    blind = velocity.with_velocity(robot, 2.5).controller.policy.policies[2]
    np.testing.assert_allclose(blind.velocity, 2.5)


def test_with_rule_sets_the_rule_of_labels_and_teacher(robot):
    ruled = supervision.with_rule(robot, "2a")
    assert float(ruled.teacher.gain_3b) == 0 and float(ruled.controller.policy.policies[0].gain_3b) == 0
    distances = jnp.asarray([0.4, 2.0])
    _, label = braitenberg.step(ruled.teacher, braitenberg.init(ruled.teacher), distances)
    vehicle = braitenberg.vehicle_2a(1 / distances, 1.2, 0.8)
    np.testing.assert_allclose(label, braitenberg.limit(ruled.teacher, vehicle), atol=1e-9)


def test_rule_3b_never_commands_more_speed_than_2a():
    """Vehicle 2a speeds up near obstacles and 3b slows down (sec. 4.2), whatever the distances."""
    distances = jnp.asarray(np.random.default_rng(0).uniform(0.05, 5.0, (200, 2)))
    speeds = []
    for rule in ("2a", "3b"):
        params = supervision.RULES[rule]
        state = braitenberg.init(params)
        commands = jax.vmap(lambda d, params=params, state=state: braitenberg.step(params, state, d)[1])(distances)
        speeds.append(np.asarray(commands.sum(axis=1)))
    assert np.all(speeds[1] <= speeds[0]) and np.mean(speeds[1]) < np.mean(speeds[0])


def test_repeats_of_a_case_are_pooled():
    rows = [
        {"policy": "learned", "rule": "2a", "variant": "lstm", "distance": 50.0, "collisions": n}
        | {"per_100_m": asdict(metrics.poisson_rate(n, 0.5))}
        for n in (1, 4)
    ]
    (case,) = supervision.pool_repeats(rows).values()
    assert (case["repeats"], case["distance"], case["collisions"], case["each"]) == (2, 100.0, 5, [2.0, 8.0])
    assert case["per_100_m"] == asdict(metrics.poisson_rate(5, 1.0))


def test_an_erratum_changes_one_thing(robot):
    before = leaves(robot)
    for name in ("eqs. 1, 3: coupling W", "eq. 22: rule alone"):
        after = leaves(errata.CASES[name](robot, Path()))
        changed = {path for path in before if not np.array_equal(before[path], after[path])}
        own = ("coupling", "full_turn", "tie_tolerance", "corridor", "base")  # of W, or of the rule
        assert changed and all(any(word in path for word in own) for path in changed)
    eyes = assembly.camera_settings(robot)
    for part, field in (
        ("whole width", {"overlap": 1.0}),
        ("with the ground", {"ground": 0.0}),
        ("equal weights", {"falloff": 0.0}),
    ):
        other = errata.CASES[f"sec. 3.3: {part}"](robot, Path())
        assert assembly.camera_settings(other) == replace(eyes, **field) != eyes
    assert errata.CASES["eq. 16: gate"](robot, Path()).controller.detector.printed_gate
    assert errata.CASES["eq. 15: signed sum"](robot, Path()).controller.detector.printed_feed_forward
    assert errata.CASES["eqs. 1, 3: sign of w_fe"](robot, Path()).controller.cpg.printed_sign


def test_with_wall_contrast_changes_the_walls_only():
    rooms = trials.sample_rooms("white", 3, 0)
    after = failure_modes.with_wall_contrast(rooms, 0.25)
    np.testing.assert_array_equal(after.arena.wall_texture[..., 1], 0.25)
    back = replace(after, arena=replace(after.arena, wall_texture=rooms.arena.wall_texture))
    jax.tree.map(np.testing.assert_array_equal, back.arena, rooms.arena)
    assert not np.any(rooms.arena.wall_texture[..., 1])


def test_every_parameter_of_sensitivity_has_the_baseline_once(robot):
    baseline = sensitivity.baseline(robot)
    values: dict[str, list[float]] = {}
    for parameter, value, changed, contrast in sensitivity.variations(robot):
        values.setdefault(parameter, []).append(value)
        if value == baseline[parameter] and parameter not in ("rate", "sway"):  # None in the unchanged robot
            assert contrast == 1.0
            jax.tree.map(np.testing.assert_array_equal, changed, robot)
    assert set(values) == set(baseline)
    for parameter, some in values.items():
        assert some.count(baseline[parameter]) == 1, parameter


def test_training_subsets_have_the_minutes_and_rooms_of_their_value():
    generator = np.random.default_rng(1)
    walks = []
    for room in range(16):
        record = vars(synthetic.walk(1, int(generator.integers(400, 900))))
        fields = {name: np.asarray(leaf)[0] for name, leaf in record.items()}
        walks.append(episodes.Walk(episode=0, robot=room, room=room, seed=0, **fields))
    whole = sum(map(len, episodes.segments(walks))) / 1800
    subsets = list(sensitivity.training_subsets(walks, seed=0))
    for _, value, some in (subset for subset in subsets if subset[0] == "minutes"):
        assert sum(map(len, some)) / 1800 == pytest.approx(value, abs=0.01)
        assert value <= whole + 1e-9
    rooms = [(value, some) for parameter, value, some in subsets if parameter == "rooms"]
    assert [value for value, _ in rooms] == [8, 16]
    for value, some in rooms:
        assert len({walk.room for walk in some}) == value
        assert sum(map(len, some)) == pytest.approx(sum(map(len, rooms[0][1])), abs=2 * value)


def test_fits_to_less_data_take_as_many_steps_up_to_a_limit():
    assert sensitivity.matched_epochs(30, 8000, 8000) == 30
    assert sensitivity.matched_epochs(30, 8000, 2000) == 120
    assert sensitivity.matched_epochs(30, 8000, 10) == 30 * sensitivity.MAX_EPOCH_FACTOR


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 3.0])
def test_head_sway_scales_the_tilt_and_keeps_the_heading(factor):
    """The tilt is the rotation without the heading (SciPy)."""
    for yaw, roll, pitch in ((0.3, 0.05, -0.1), (-2.5, -0.2, 0.02), (3.0, 0.0, 0.1)):
        heading = Rotation.from_euler("z", yaw)
        tilt = Rotation.from_rotvec([roll, pitch, 0.0])
        before = (heading * tilt).as_quat(scalar_first=True)
        pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray(before))
        after = hexapod.scale_tilt(pose, jnp.asarray(factor)).quaternion
        expected = heading * Rotation.from_rotvec([factor * roll, factor * pitch, 0.0])
        turned = Rotation.from_quat(np.asarray(after), scalar_first=True)
        assert (turned * expected.inv()).magnitude() < 1e-7


def test_a_level_head_does_not_sway():
    pose = hexapod.Pose(position=jnp.zeros(3), quaternion=jnp.asarray([np.cos(0.4), 0.0, 0.0, np.sin(0.4)]))
    np.testing.assert_allclose(hexapod.scale_tilt(pose, jnp.asarray(3.0)).quaternion, pose.quaternion, atol=1e-12)


def test_correlation_with_proximity_of_a_synthetic_walk():
    generator = np.random.default_rng(2)
    distances = 1.0 + 0.5 * np.sin(np.arange(1200)[None, :, None] / 60 + np.array([0.0, 2.0]))
    u = 0.5 + 0.05 / distances + np.repeat(generator.normal(0, 0.004, (1, 1200, 1)), 2, axis=-1)
    found = lgmd_grid_search.correlate_with_proximity(replace(synthetic.walk(1, 1200), u=u, distances=distances))
    assert found["score"] > 0.99  # the noise is the same in both detectors
    assert 0.8 < found["left"] < found["score"]


def test_a_study_runs_from_the_command_line(tmp_path, monkeypatch):
    """With synthetic walks of a few centimetres straight on, in which no robot turns back or touches anything."""
    monkeypatch.setattr(
        recording, "record_rollouts", lambda folder, params, rooms, *_, **__: synthetic.walk(len(rooms.starts), 60)
    )
    settings = FailureModesSettings(benchmark=BenchmarkRooms(eyes=EYES, robots=2, seconds=2.0))
    study.run_study("failure_modes", flags.StudyFlags(settings=settings, out=tmp_path))
    folder = tmp_path / "failure_modes-0" / "failure_modes"
    rows = json.loads((folder / "failure_modes.json").read_text())
    assert len({(row["trial"], row["contrast"], row["policy"]) for row in rows}) == len(rows) == 13
    assert all((row["robots"], row["untouched"], row["retreated"]) == (2, 2, 0) for row in rows)
    assert (folder / "failure_modes.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "module",
    [velocity, supervision, errata, failure_modes, sensitivity, overlap, gait_gradient, gradient_horizon],
    ids=lambda module: module.__name__.rpartition(".")[2],
)
def test_figures_can_be_plotted(module):
    rows = synthetic.rows_of(module.__name__.rpartition(".")[2])
    figure = module.plot(rows)
    assert style.to_svg(figure) == style.to_svg(module.plot(rows))
    assert any(axes.lines or axes.patches for axes in figure.axes)


def test_overlap_needs_recorded_walks(tmp_path):
    settings = scales.STUDY_PRESETS["overlap"]
    assert isinstance(settings, OverlapSettings)
    with pytest.raises(InputError, match="expected a run whose recorded walks"):
        overlap.run(tmp_path, {"fit-gait": PRETRAINED_DIR}, settings, 0)


def test_overlap_scores_recorded_walks_in_their_rooms(tmp_path, monkeypatch):
    """On an episode of version 0.1.0, with synthetic walks toward the tube."""
    run_folder = Path(__file__).parents[1] / "data" / "v0.1.0" / "smoke-0"
    scored = []

    def proximity_correlation(detector, camera_params, rooms, record):
        scored.append((camera_params.overlap, rooms.bounds.shape[0], record.u.shape[:2]))
        return 0.5

    monkeypatch.setattr(overlap, "proximity_correlation", proximity_correlation)
    monkeypatch.setattr(
        recording, "record_rollouts", lambda folder, params, rooms, *_, **__: synthetic.walk(len(rooms.starts), 60)
    )
    inputs = {name: run_folder / name for name in ("fit-gait", "collect")}
    overlap.run(tmp_path, inputs, OverlapSettings(robots=2, seeds=1, overlaps=(0.5, 1.0)), 0)
    assert scored == [(0.5, 2, (2, 60)), (1.0, 2, (2, 60))]
    rows = json.loads((tmp_path / "overlap.json").read_text())
    assert [(row["overlap"], row["episodes"]) for row in rows] == [(0.5, [0.5]), (1.0, [0.5])]
    assert all(0 <= row["tube"] <= 1 for row in rows)


@pytest.mark.parametrize(("louder", "expected"), [("tube", 1.0), ("other", 0.0)])
def test_side_accuracy_is_the_share_of_walks_with_the_stronger_u_on_the_tubes_side(
    robot, monkeypatch, tmp_path, louder, expected
):
    """While the tube is 0.7 to 0.9 m away; elsewhere, u is stronger on the other side."""
    rooms = trials.sample_rooms("tube", 1, 0)
    count, frames = len(rooms.starts), 300
    position = np.zeros((count, frames, 3))
    position[..., 0] = np.linspace(0.0, 1.0, frames)
    near = (trials.TUBE_DISTANCE - position[..., 0] > 0.7) & (trials.TUBE_DISTANCE - position[..., 0] < 0.9)
    left = (np.asarray(rooms.arena.handedness) > 0)[:, None] == (near if louder == "tube" else ~near)
    u = np.where(np.stack([left, ~left], axis=-1), 0.6, 0.5)
    record = synthetic.walk(count, frames, position=position, u=u)
    monkeypatch.setattr(recording, "record_rollouts", lambda *_, **__: record)
    assert overlap.side_accuracy(tmp_path, robot, 1, 0) == expected


def test_u_is_constant_between_two_pictures(robot):
    """With a picture every third frame, u changes in every third frame only."""
    room = room_batches.training_rooms(0, 0, 1)
    room = jax.tree.map(lambda leaf: leaf[0], room)
    model = hexapod.build()
    slow = assembly.with_camera(robot, CameraSettings(width=16, height=12))
    slow = replace(slow, frame_stride=jnp.asarray(3, jnp.int32))
    state = closed_loop.init(slow, model, room, policies.SWITCH)
    observe = jax.jit(lambda state: closed_loop.observe(slow, room.arena, state)[0])
    responses = []
    for frame in range(7):
        state = replace(state, frame=jnp.asarray(frame, jnp.int32), is_first=jnp.asarray(frame == 0))
        moved = state.data.replace(qpos=state.data.qpos.at[0].add(0.01))
        state = observe(replace(state, data=moved))
        responses.append(np.asarray(state.response.u))
    changed = [bool(np.any(before != after)) for before, after in pairwise(responses)]
    assert changed == [False, False, True, False, False, True]


def test_gait_params_start_from_the_pretrained_gait_and_stay_mirror_symmetric():
    """Mirrored CPG signals and exchanged velocities of the sides give mirrored targets."""
    legs = gait_objective.from_shaping(shaping.load_pretrained())
    rhythm, networks = gait_objective.unpack(legs)
    jax.tree.map(
        partial(np.testing.assert_allclose, atol=1e-6), (rhythm, networks), (cpg.Params(), shaping.load_pretrained())
    )
    changed = replace(
        legs,
        shaping=jax.tree.map(
            lambda leaf: leaf + 0.1 * jnp.cos(jnp.arange(leaf.size)).reshape(leaf.shape), legs.shaping
        ),
    )
    networks = gait_objective.unpack(changed)[1]
    signal = jnp.asarray(np.random.default_rng(3).normal(size=(6, 2)))
    there = shaping.apply(networks, signal, jnp.asarray([1.3, 0.4]))
    mirrored = shaping.apply(networks, signal[::-1], jnp.asarray([0.4, 1.3]))
    np.testing.assert_allclose(mirrored, there[::-1] * np.array([-1.0, 1.0, 1.0]), atol=1e-12)


@pytest.mark.slow
def test_derivative_of_a_window_agrees_in_three_ways():
    """The derivative of all summaries by networks, cycle time and couplings, from the middle of a step."""
    legs, model = gait_objective.from_shaping(shaping.load_pretrained()), hexapod.soften_contacts(hexapod.build())
    walker, velocity = jax.jit(gait_objective.init)(legs, model, 0.15), jnp.asarray([1.2, 0.8])

    def measured(legs):
        course, _ = gait_objective.rollout(legs, model, walker, velocity, 24)
        return 20 * course.speed + course.yaw_rate + course.sway + course.effort

    routes = DerivativeCheck(measured)
    routes.assert_agree(legs)
    routes.assert_every_leaf_agrees(legs)


def test_evolution_strategy_estimates_the_gradient_of_reverse_mode():
    """Quadratic losses of four robots, many pairs; a robot whose loss is not finite does not count."""
    start = {"a": jnp.asarray([0.3, -0.2, 1.0]), "b": jnp.asarray(0.5)}
    goals = jnp.asarray([1.0, 0.5, 1.5, jnp.nan])

    def loss(params, goal):
        return jnp.sum((params["a"] - goal) ** 2) + 3 * params["b"] ** 2, 2 * goal

    preset = scales.STUDY_PRESETS["gait_gradient"]
    assert isinstance(preset, GaitGradientSettings)
    settings = replace(preset, pairs=20000)
    value, exact, ends = gait_gradient.METHODS["gradient"](loss, settings)(start, goals, jax.random.key(0))
    mean, estimate, same = gait_gradient.METHODS["evolution"](loss, settings)(start, goals, jax.random.key(0))
    np.testing.assert_allclose(exact["a"], 2 * (start["a"] - 1))
    np.testing.assert_allclose(ends, 2 * goals)
    np.testing.assert_allclose(same, 2 * goals)
    assert mean == pytest.approx(float(value), rel=0.01)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=0.15), estimate, exact)


def test_summary_of_a_window_does_not_depend_on_the_phase_of_the_gait():
    """A robot with a heading of 0.5 rad, a speed that varies by half, and a turn rate of 0.1 rad/s."""
    speed, turn, cycle, steps = 0.05, 0.1, 0.8, 288
    measured = []
    for phase in (0.0, 1.3, 2.9):
        time = np.arange(steps + 1) / 180
        swing = 4 * np.pi / cycle  # twice a cycle
        along = speed * (time - 0.5 / swing * np.cos(swing * time + phase))
        yaw = 0.5 + turn * (time - time[-1] / 2) + 0.02 * np.sin(swing / 2 * time + phase)
        way = np.stack([along * np.cos(0.5), along * np.sin(0.5)], axis=1)
        tilt = 0.01 * np.stack([np.sin(swing * time[1:]), np.cos(swing * time[1:])], axis=1)
        course = gait_objective.summarise(*map(jnp.asarray, (way, yaw, tilt, np.full((steps, 18), 0.3))))
        measured.append((float(course.speed), float(course.yaw_rate), float(course.sway), float(course.effort)))
    np.testing.assert_allclose(measured, [(speed, turn, 0.01, 0.3)] * 3, rtol=0.02)
