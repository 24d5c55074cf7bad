"""Gait metrics of trajectories with known speed, turning and sway."""

from pathlib import Path

import numpy as np
import pytest

from lgmdjax.errors import InputError
from lgmdjax.evaluation import gait_test
from lgmdjax.pipeline import fit_gait
from lgmdjax.pipeline.settings import FitGaitSettings

CYCLE = 1.0  # s


def trajectory(
    speed: float = 0.05,
    turn: float = 0.0,
    heading: float = 0.0,
    seconds: float = 20.0,
    *,
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    heave: float = 0.0,
) -> gait_test.GaitTrajectory:
    """Return a walk at constant speed and turn, with sway of these amplitudes, each at its own phase of the cycle."""
    t = np.arange(round(seconds / gait_test.TIME_STEP)) * gait_test.TIME_STEP
    sway = lambda amplitude, phase: amplitude * np.sin(2 * np.pi * t / CYCLE + phase)  # noqa: E731
    headings = heading + turn * t
    steps = speed * gait_test.TIME_STEP * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    position = np.column_stack([np.cumsum(steps, axis=0), 0.1 + sway(heave, 0.3)])
    # Small angles, one after the other: yaw about z, pitch about y, roll about x.
    quaternion = _product(_about(2, headings + sway(yaw, 0.7)), _about(1, sway(pitch, 1.1)), _about(0, sway(roll, 2.0)))
    return gait_test.GaitTrajectory(position=position, quaternion=quaternion, feet=np.zeros((len(t), 6, 3)))


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    quaternion = np.zeros((len(angle), 4))
    quaternion[:, 0], quaternion[:, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternion


def _product(*factors: np.ndarray) -> np.ndarray:
    product = factors[0]
    for b in factors[1:]:
        a = product
        vector = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
        product = np.column_stack([a[:, 0] * b[:, 0] - np.sum(a[:, 1:] * b[:, 1:], axis=1), vector])
    return product


@pytest.mark.parametrize("speed", [0.05, -0.03, 0.0])
@pytest.mark.parametrize("heading", [0.0, 2.0, np.pi])
def test_speed_is_along_the_heading(speed, heading):
    metrics = gait_test.measure_gait(trajectory(speed, heading=heading), CYCLE)
    assert metrics.speed == pytest.approx(speed, abs=1e-6)
    assert metrics.yaw_rate == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("turn", [0.01, -0.01, 0.4, -0.4])
def test_turning_is_unwrapped_through_full_circles(turn):
    """Positive to the left, at most 8 rad in 20 s; the drift is the final heading."""
    metrics = gait_test.measure_gait(trajectory(0.0, turn), CYCLE)
    assert metrics.yaw_rate == pytest.approx(turn, abs=1e-6)
    assert metrics.drift == pytest.approx(20 * turn, rel=1e-3)


def test_sway_is_its_rms_about_the_mean_and_the_trend():
    amplitudes = {"roll": 0.01, "pitch": 0.02, "yaw": 0.03, "heave": 0.002}
    for name, amplitude in amplitudes.items():
        metrics = gait_test.measure_gait(trajectory(0.05, 0.1, **{name: amplitude}), CYCLE)
        assert getattr(metrics, name) == pytest.approx(amplitude / np.sqrt(2), rel=0.02), name
        for other in amplitudes.keys() - {name}:
            assert getattr(metrics, other) < 1e-3 * amplitude + 1e-6, (name, other)


def test_sway_does_not_change_speed_and_yaw_rate():
    """Only whole cycles are measured, so part of a cycle of yaw is neither turning nor speed."""
    for seconds in (10.0, 10.5, 11.3):
        metrics = gait_test.measure_gait(trajectory(0.05, seconds=seconds, yaw=0.05), CYCLE)
        assert metrics.yaw_rate == pytest.approx(0, abs=1e-4)
        assert metrics.speed == pytest.approx(0.05, rel=2e-3)


def test_the_settling_time_is_left_out():
    """Sway while the gait settles does not change the metrics."""
    steady, swaying = trajectory(), trajectory(roll=0.3, pitch=0.2, heave=0.05)
    settling = np.arange(len(steady.position)) < round(gait_test.SETTLING_TIME / gait_test.TIME_STEP)
    mixed = gait_test.GaitTrajectory(
        position=np.where(settling[:, None], swaying.position, steady.position),
        quaternion=np.where(settling[:, None], swaying.quaternion, steady.quaternion),
        feet=steady.feet,
    )
    assert gait_test.measure_gait(mixed, CYCLE) == gait_test.measure_gait(steady, CYCLE)


def test_a_walk_without_a_whole_cycle_is_refused():
    least = gait_test.SETTLING_TIME + CYCLE + gait_test.TIME_STEP
    gait_test.measure_gait(trajectory(0.05, seconds=least), CYCLE)
    with pytest.raises(InputError, match=r"expected walks of .* s or more to measure a gait, got 3 s"):
        gait_test.measure_gait(trajectory(0.05, seconds=3.0), CYCLE)
    with pytest.raises(InputError, match=r"got 3 s; walk longer"):
        fit_gait.run(Path("nowhere"), {}, FitGaitSettings(steps=1, seconds=3), 0)
