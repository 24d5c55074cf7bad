"""A pure state machine that decides when the robot may walk, and when it must stand, sit or turn its torque off.

| mode  | the robot                                                                  | next                         |
| ----- | -------------------------------------------------------------------------- | ---------------------------- |
| rise  | moves slowly from wherever its legs are to its stance                      | stand, once there            |
| stand | holds its stance                                                           | walk, after enough frames    |
| walk  | follows the nervous system                                                 | stand, without a new frame   |
| sit   | lowers its trunk to the floor                                              | off, once there              |
| off   | has no torque; the end                                                     |                              |

In every mode but off, a lost bus or a second request to stop turns the torque off at once; otherwise a fault or a first
request makes the robot sit down. Sit leads only to off, and off is final.
"""

from dataclasses import dataclass, replace
from enum import Enum


class Mode(Enum):
    """What the robot does."""

    RISE = "rise"
    STAND = "stand"
    WALK = "walk"
    SIT = "sit"
    OFF = "off"


class Reason(Enum):
    """Why the robot sits down or turns its torque off; the value is shown to the user."""

    STOPPED = "asked to stop"
    FINISHED = "time is up"
    NO_FRAMES = "no pictures came"
    BUS_ERROR = "servos did not answer as they should"
    BUS_LOST = "the servos' port is gone"
    LOW_VOLTAGE = "the voltage is low"
    HOT = "a servo is hot"
    OVERLOADED = "a servo shut down after an overload"
    FALLEN = "the robot fell over"


@dataclass(frozen=True, kw_only=True)
class Params:
    """Limits, in the robot's time."""

    frame_timeout: float = 0.2  # s without a new frame after which the robot stands
    frames_for: float = 0.5  # s of frames before it walks
    stand_timeout: float = 10.0  # s without frames after which it sits down
    rise_timeout: float = 10.0  # s in which it has to reach its stance, or sit down again
    sit_timeout: float = 6.0  # s after which it counts as sitting
    lowest_voltage: float = 9.6  # V; three cells of 3.2 V
    highest_temperature: float = 70.0  # degrees Celsius


@dataclass(frozen=True, kw_only=True)
class Readings:
    """What is known at one moment; a fault that cannot be known, as without an inertial sensor, counts as absent."""

    time: float  # s
    frame_age: float  # s since the last new frame; infinite before the first
    arrived: bool  # the legs have reached the posture of the mode
    stop_requests: int = 0  # requests to stop: Ctrl-C, SIGTERM, SIGHUP
    finished: bool = False  # the time that the user gave is up
    bus_error: bool = False  # a servo is silent or garbled for too long
    bus_lost: bool = False  # nothing can be sent
    voltage: float | None = None  # V
    temperature: float | None = None  # degrees Celsius, of the hottest servo
    overloaded: bool = False
    fallen: bool = False


@dataclass(frozen=True, kw_only=True)
class State:
    """The mode, since when, since when frames have come without a gap, and why it sits or is off."""

    mode: Mode
    since: float  # s
    frames_since: float | None = None  # s
    reason: Reason | None = None


def init(time: float) -> State:
    """Return the state at the start: rise."""
    return State(mode=Mode.RISE, since=time)


def step(params: Params, state: State, readings: Readings) -> State:
    """Return the next state, from what is known now."""
    state = replace(state, frames_since=_frames_since(params, state, readings))
    if state.mode is Mode.OFF:
        return state
    if readings.bus_lost:
        return _enter(state, Mode.OFF, readings, Reason.BUS_LOST)
    if readings.stop_requests >= 2:
        return _enter(state, Mode.OFF, readings, state.reason or Reason.STOPPED)
    if state.mode is Mode.SIT:
        seated = readings.arrived or readings.time - state.since > params.sit_timeout
        return _enter(state, Mode.OFF, readings, state.reason) if seated else state
    if (reason := _reason_to_sit(params, state, readings)) is not None:
        return _enter(state, Mode.SIT, readings, reason)
    if state.mode is Mode.RISE:
        return _enter(state, Mode.STAND, readings) if readings.arrived else state
    if readings.frame_age > params.frame_timeout:
        return _enter(state, Mode.STAND, readings) if state.mode is Mode.WALK else state
    if state.mode is Mode.STAND and readings.arrived and _has_frames(params, state, readings):
        return _enter(state, Mode.WALK, readings)
    return state


def _reason_to_sit(params: Params, state: State, readings: Readings) -> Reason | None:
    """Return the first reason to sit down; None if there is none."""
    elapsed = readings.time - state.since
    waits = state.mode is Mode.STAND and readings.frame_age > params.frame_timeout
    reasons = {
        Reason.FALLEN: readings.fallen,
        Reason.BUS_ERROR: readings.bus_error,
        Reason.HOT: readings.temperature is not None and readings.temperature >= params.highest_temperature,
        Reason.OVERLOADED: readings.overloaded or (state.mode is Mode.RISE and elapsed > params.rise_timeout),
        Reason.LOW_VOLTAGE: readings.voltage is not None and readings.voltage < params.lowest_voltage,
        Reason.STOPPED: readings.stop_requests > 0,
        Reason.FINISHED: readings.finished,
        Reason.NO_FRAMES: waits and elapsed > params.stand_timeout,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def _frames_since(params: Params, state: State, readings: Readings) -> float | None:
    """Return since when frames have come without a gap."""
    if readings.frame_age > params.frame_timeout:
        return None
    return readings.time if state.frames_since is None else state.frames_since


def _has_frames(params: Params, state: State, readings: Readings) -> bool:
    return state.frames_since is not None and readings.time - state.frames_since >= params.frames_for


def _enter(state: State, mode: Mode, readings: Readings, reason: Reason | None = None) -> State:
    return replace(state, mode=mode, since=readings.time, reason=reason)
