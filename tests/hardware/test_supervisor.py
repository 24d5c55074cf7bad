"""The supervisor, over every mode and every combination of what it can be told."""

import itertools
import math
from dataclasses import replace

import pytest

from lgmdjax.hardware import supervisor
from lgmdjax.hardware.supervisor import Mode, Readings, Reason, State

PARAMS = supervisor.Params()
NOW = 100.0
FAULTS = {
    "bus_error": Reason.BUS_ERROR,
    "fallen": Reason.FALLEN,
    "overloaded": Reason.OVERLOADED,
    "low": Reason.LOW_VOLTAGE,
    "hot": Reason.HOT,
}


def every_state() -> list[State]:
    """All modes, entered just now or long ago, with frames for a while, for a moment, or without any."""
    return [
        State(mode=mode, since=NOW - elapsed, frames_since=since, reason=Reason.STOPPED if ends else None)
        for mode in Mode
        for elapsed in (0.0, 100.0)
        for since in (None, NOW - 0.1, NOW - 60.0)
        for ends in [mode in (Mode.SIT, Mode.OFF)]
    ]


def every_reading() -> list[tuple[Readings, frozenset[str]]]:
    """All combinations of frames, arrival, stops and up to two faults, and their names."""
    found = []
    ages, stops = (0.2, 0.21, math.inf), (0, 1, 2)
    for age, arrived, asked, finished, lost in itertools.product(ages, (0, 1), stops, (0, 1), (0, 1)):
        for names in itertools.chain.from_iterable(itertools.combinations(FAULTS, k) for k in range(3)):
            readings = Readings(
                time=NOW,
                frame_age=age,
                arrived=bool(arrived),
                stop_requests=asked,
                finished=bool(finished),
                bus_lost=bool(lost),
                bus_error="bus_error" in names,
                fallen="fallen" in names,
                overloaded="overloaded" in names,
                voltage=9.59 if "low" in names else 9.6,
                temperature=70.0 if "hot" in names else 69.9,
            )
            found.append((readings, frozenset(names)))
    return found


@pytest.fixture(scope="module")
def transitions() -> list[tuple[State, Readings, frozenset[str], State]]:
    return [
        (state, readings, names, supervisor.step(PARAMS, state, readings))
        for state in every_state()
        for readings, names in every_reading()
    ]


def test_nothing_leads_out_of_off_and_only_off_follows_sit(transitions) -> None:
    assert len(transitions) == 30 * 72 * 16
    for state, _, _, after in transitions:
        if state.mode is Mode.OFF:
            assert after.mode is Mode.OFF and after.reason is state.reason
        if state.mode is Mode.SIT:
            assert after.mode in (Mode.SIT, Mode.OFF)


def test_every_fault_ends_in_sitting_or_without_torque_at_once(transitions) -> None:
    for state, readings, names, after in transitions:
        at_once = readings.bus_lost or readings.stop_requests >= 2
        if state.mode is Mode.OFF:
            continue
        assert not at_once or after.mode is Mode.OFF
        if (names or readings.stop_requests or readings.finished) and not at_once:
            assert after.mode in (Mode.SIT, Mode.OFF)
            assert after.mode is Mode.SIT or state.mode is Mode.SIT  # nothing lets go without having sat down
        if after.mode in (Mode.SIT, Mode.OFF):
            assert after.reason is not None


def test_the_reason_is_one_that_holds(transitions) -> None:
    for state, readings, names, after in transitions:
        if state.mode in (Mode.SIT, Mode.OFF) or after.mode in (Mode.RISE, Mode.STAND, Mode.WALK):
            continue
        holding = {FAULTS[name] for name in names}
        holding |= {Reason.STOPPED} if readings.stop_requests else set()
        holding |= {Reason.FINISHED} if readings.finished else set()
        holding |= {Reason.BUS_LOST} if readings.bus_lost else set()
        holding |= {Reason.OVERLOADED} if state.mode is Mode.RISE else set()  # it did not get up in time
        holding |= {Reason.NO_FRAMES} if state.mode is Mode.STAND else set()
        assert after.reason in holding


def test_it_walks_only_with_fresh_frames_that_came_for_a_while(transitions) -> None:
    for state, readings, _, after in transitions:
        if after.mode is not Mode.WALK:
            continue
        assert state.mode in (Mode.STAND, Mode.WALK)
        assert readings.frame_age <= PARAMS.frame_timeout
        if state.mode is Mode.STAND:
            assert readings.arrived and state.frames_since is not None
            assert NOW - state.frames_since >= PARAMS.frames_for


def test_without_a_frame_for_longer_than_the_timeout_it_stands(transitions) -> None:
    for state, readings, names, after in transitions:
        healthy = not (names or readings.stop_requests or readings.finished or readings.bus_lost)
        if state.mode is Mode.WALK and healthy:
            assert after.mode is (Mode.STAND if readings.frame_age > 0.2 else Mode.WALK)
        if state.mode is Mode.STAND and healthy and readings.frame_age > 0.2:
            long = NOW - state.since > PARAMS.stand_timeout
            assert after.mode is (Mode.SIT if long else Mode.STAND)


def test_sitting_ends_when_the_legs_are_there_or_after_its_time(transitions) -> None:
    for state, readings, _, after in transitions:
        if state.mode is Mode.SIT and not readings.bus_lost and readings.stop_requests < 2:
            ended = readings.arrived or NOW - state.since > PARAMS.sit_timeout
            assert after.mode is (Mode.OFF if ended else Mode.SIT)
            assert after.reason is state.reason


def test_a_life_from_rising_to_the_end() -> None:
    state, time, modes = supervisor.init(0.0), 0.0, []
    story = [  # until when, frame age, arrived, stops
        (2.0, math.inf, False, 0),
        (3.0, math.inf, True, 0),
        (5.0, 0.01, True, 0),
        (5.5, 0.3, False, 0),
        (7.0, 0.01, True, 0),
        (8.0, 0.01, False, 1),
        (9.0, 0.01, True, 1),
    ]
    for until, age, arrived, stops in story:
        while time < until:
            readings = Readings(time=time, frame_age=age, arrived=arrived, stop_requests=stops, temperature=None)
            state = supervisor.step(PARAMS, state, readings)
            modes += [state.mode] if modes[-1:] != [state.mode] else []
            time += 0.05
    wanted = [Mode.RISE, Mode.STAND, Mode.WALK, Mode.STAND, Mode.WALK, Mode.SIT, Mode.OFF]
    assert modes == wanted and state.reason is Reason.STOPPED


def test_it_gives_up_rising_after_its_time() -> None:
    state = supervisor.init(0.0)
    readings = Readings(time=10.1, frame_age=math.inf, arrived=False)
    assert supervisor.step(PARAMS, state, readings).mode is Mode.SIT
    assert supervisor.step(PARAMS, state, replace(readings, time=9.9)).mode is Mode.RISE
