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
class Senses:
    """What is known at one moment; a fault that cannot be known, as without an inertial sensor, counts as absent."""

    time: float  # s
    frame_age: float  # s since the last new frame; infinite before the first
    arrived: bool  # the legs have reached the posture of the mode
    stops: int = 0  # requests to stop: Ctrl-C, SIGTERM, SIGHUP
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


def step(params: Params, state: State, senses: Senses) -> State:
    """Return the next state, from what is known now."""
    state = replace(state, frames_since=_frames_since(params, state, senses))
    if state.mode is Mode.OFF:
        return state
    if senses.bus_lost:
        return _enter(state, Mode.OFF, senses, Reason.BUS_LOST)
    if senses.stops >= 2:
        return _enter(state, Mode.OFF, senses, state.reason or Reason.STOPPED)
    if state.mode is Mode.SIT:
        seated = senses.arrived or senses.time - state.since > params.sit_timeout
        return _enter(state, Mode.OFF, senses, state.reason) if seated else state
    if (reason := _reason_to_sit(params, state, senses)) is not None:
        return _enter(state, Mode.SIT, senses, reason)
    if state.mode is Mode.RISE:
        return _enter(state, Mode.STAND, senses) if senses.arrived else state
    if senses.frame_age > params.frame_timeout:
        return _enter(state, Mode.STAND, senses) if state.mode is Mode.WALK else state
    if state.mode is Mode.STAND and senses.arrived and _has_frames(params, state, senses):
        return _enter(state, Mode.WALK, senses)
    return state


def _reason_to_sit(params: Params, state: State, senses: Senses) -> Reason | None:
    """Return the first reason to sit down; None if there is none."""
    elapsed = senses.time - state.since
    waits = state.mode is Mode.STAND and senses.frame_age > params.frame_timeout
    reasons = {
        Reason.FALLEN: senses.fallen,
        Reason.BUS_ERROR: senses.bus_error,
        Reason.HOT: senses.temperature is not None and senses.temperature >= params.highest_temperature,
        Reason.OVERLOADED: senses.overloaded or (state.mode is Mode.RISE and elapsed > params.rise_timeout),
        Reason.LOW_VOLTAGE: senses.voltage is not None and senses.voltage < params.lowest_voltage,
        Reason.STOPPED: senses.stops > 0,
        Reason.FINISHED: senses.finished,
        Reason.NO_FRAMES: waits and elapsed > params.stand_timeout,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def _frames_since(params: Params, state: State, senses: Senses) -> float | None:
    """Return since when frames have come without a gap."""
    if senses.frame_age > params.frame_timeout:
        return None
    return senses.time if state.frames_since is None else state.frames_since


def _has_frames(params: Params, state: State, senses: Senses) -> bool:
    return state.frames_since is not None and senses.time - state.frames_since >= params.frames_for


def _enter(state: State, mode: Mode, senses: Senses, reason: Reason | None = None) -> State:
    return replace(state, mode=mode, since=senses.time, reason=reason)
