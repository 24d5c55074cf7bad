"""Scores of an alarm on labelled clips: hits, false alarms, lead time, and area under ROC.

An alarm is a response that stays above a threshold for some time; gaps of up to 0.5 s do not end it.

| word        | meaning                                                                                              |
| ----------- | ---------------------------------------------------------------------------------------------------- |
| window      | from 1.5 s before contact to 0.1 s after it; labels are exact to 0.1 s                               |
| hit         | there is an alarm in the window; without a time of contact, anywhere in a clip that approaches       |
| lead        | time from the first alarm in the window to contact [s], at most 1.5                                  |
| false alarm | an alarm begins before the window, or anywhere in a clip that does not approach                      |
| minutes     | time before the windows, and of clips that do not approach; what follows contact does not count      |
| stretch     | about 1.5 s of those minutes                                                                         |
| AUC         | area under ROC: largest responses in the windows against those in the stretches                      |

Threshold and persistence maximise the share of hits minus the share of stretches with a false alarm. Of equally good
choices, the middle of the widest range of thresholds is taken, with the shortest persistence. They are never chosen on
the clips that are scored, but by leave-one-out, or on one half of the clips for the other half.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lgmdjax.detectors import alarm
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics
from lgmdjax.evaluation.clip_labels import Label
from lgmdjax.runtime.storage import JsonObject

WINDOW = 1.5  # s before contact
LATE = 0.1  # s after contact
PEAK_TOLERANCE = 0.4  # s, between the largest response of a clip and contact
PERSISTENCES = (0.0, 0.1, 0.2, 0.3)  # s
THRESHOLDS = 100  # number of quantiles that are tried, and of evenly spaced values
LEVEL = 1e-9  # two scores this close count as equal


class Series(NamedTuple):
    """A response over the frames of a labelled clip."""

    label: Label
    rate: float  # frames a second
    time: Float[np.ndarray, " frames"]
    response: Float[np.ndarray, " frames"]


class Setting(NamedTuple):
    """An alarm's constants."""

    threshold: float
    persistence: float  # s


class Counts(NamedTuple):
    """Hits and false alarms in one clip, for each persistence and threshold."""

    hits: Bool[np.ndarray, "persistences thresholds"]
    leads: Float[np.ndarray, "persistences thresholds"]  # s; nan without a hit or a time of contact
    false_alarms: Float[np.ndarray, "persistences thresholds"]
    alarmed: Float[np.ndarray, "persistences thresholds"]  # stretches in which there is an alarm
    negative_segments: int  # number of stretches
    minutes: float
    is_approach: bool


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Scores of alarms on some clips."""

    hits: int
    approaches: int
    hit_rate: metrics.Estimate
    false_alarms: int
    minutes: float
    false_alarms_a_minute: metrics.Estimate
    lead: metrics.Estimate  # s, mean


def score(series: Sequence[Series]) -> JsonObject:
    """Return all scores of one response on labelled clips; see the module for their meaning.

    Raises `InputError` if there are fewer than two clips that approach.
    """
    if sum(each.label.is_approach for each in series) < 2:
        raise InputError("expected two clips or more that approach, got fewer; label more clips")
    thresholds = _candidates(np.concatenate([each.response for each in series]))
    counts = [count(each, thresholds, PERSISTENCES) for each in series]
    everything = range(len(series))

    def choose_without(left_out: Sequence[int]) -> tuple[int, int]:
        return choose([counts[k] for k in everything if k not in left_out])

    halves = split_halves([each.label for each in series])
    best = choose(counts)
    return {
        "auc": area(series),
        "peaks_at_contact": sum(peak_is_at_contact(each) for each in series),
        "contacts": sum(each.label.contact is not None for each in series),
        "setting": Setting(float(thresholds[best[1]]), PERSISTENCES[best[0]])._asdict(),
        "leave_one_out": asdict(summarise(counts, [choose_without([k]) for k in everything])),
        "halves": asdict(
            summarise(counts, [choose_without(halves[0] if k in halves[0] else halves[1]) for k in everything])
        ),
        "roc": roc(counts, best[0]),
        "alarms": [alarm_onsets(each, Setting(float(thresholds[best[1]]), PERSISTENCES[best[0]])) for each in series],
    }


def _candidates(responses: Float[np.ndarray, " n"]) -> Float[np.ndarray, " thresholds"]:
    """Return thresholds to try: quantiles, since responses may be crowded near 1, and evenly spaced ones."""
    even = np.linspace(responses.min(), responses.max(), THRESHOLDS)
    return np.unique(np.concatenate([np.quantile(responses, np.linspace(0, 1, THRESHOLDS)), even]))


def score_fixed(series: Sequence[Series], setting: Setting) -> JsonObject:
    """Return the scores of an alarm whose constants were not chosen on any clip."""
    counts = [count(each, np.asarray([setting.threshold]), (setting.persistence,)) for each in series]
    return asdict(summarise(counts, [(0, 0)] * len(counts)))


def alarm_onsets(series: Series, setting: Setting) -> list[float]:
    """Return when the alarms begin [s]."""
    is_on = _alarmed(series, np.asarray([setting.threshold]), setting.persistence)
    return series.time[_onsets(is_on, series.rate)[:, 0]].tolist()


def window(label: Label) -> tuple[float, float]:
    """Return the interval [s] in which an alarm is a hit: all of an approach without contact, none of other clips."""
    if not label.is_approach:
        return np.inf, np.inf
    return (-np.inf, np.inf) if label.contact is None else (label.contact - WINDOW, label.contact + LATE)


def count(series: Series, thresholds: Float[np.ndarray, " thresholds"], persistences: Sequence[float]) -> Counts:
    """Count hits and false alarms in a clip, for every persistence and threshold."""
    low, high = window(series.label)
    in_window = (series.time >= low) & (series.time <= high)
    before = series.time < low
    stretches = _stretches(series)
    is_on = [_alarmed(series, thresholds, persistence) for persistence in persistences]
    first = [_first_time(series.time, each & in_window[:, None]) for each in is_on]
    contact = np.inf if series.label.contact is None else series.label.contact
    leads = [np.where(np.isfinite(each) & np.isfinite(contact), contact - each, np.nan) for each in first]
    none = np.zeros(len(thresholds))
    return Counts(
        hits=np.isfinite(first),
        leads=np.asarray(leads),
        false_alarms=np.asarray([(_onsets(each, series.rate) & before[:, None]).sum(axis=0) for each in is_on], float),
        alarmed=np.asarray([sum((each[part].any(axis=0) for part in stretches), none) for each in is_on]),
        negative_segments=len(stretches),
        minutes=float(before.sum()) / series.rate / 60,
        is_approach=series.label.is_approach,
    )


def _first_time(time: np.ndarray, is_on: np.ndarray) -> np.ndarray:
    """Return the time of the first frame with an alarm for each threshold; nan without one."""
    return np.where(is_on.any(axis=0), time[is_on.argmax(axis=0)], np.nan)


def _alarmed(series: Series, thresholds: np.ndarray, persistence: float) -> Bool[np.ndarray, "frames thresholds"]:
    """Return the frames with an alarm, which begins when the response has lasted as many frames as it must."""
    frames = alarm.required_frames(persistence, 1 / series.rate)
    padded = np.concatenate([np.full(frames - 1, -np.inf), series.response])
    lasting = np.lib.stride_tricks.sliding_window_view(padded, frames).min(axis=1)
    return lasting[:, None] >= thresholds


def _onsets(is_on: Bool[np.ndarray, "frames thresholds"], rate: float) -> Bool[np.ndarray, "frames thresholds"]:
    """Return the frames in which an alarm begins, after a gap of more than `alarm.GAP` or at the beginning."""
    index = np.arange(len(is_on))[:, None]
    last = np.maximum.accumulate(np.where(is_on, index, -len(is_on) - rate), axis=0)
    before = np.concatenate([np.full((1, is_on.shape[1]), -len(is_on) - rate), last[:-1]])
    return is_on & (index - before > alarm.GAP * rate + 1)


def _stretches(series: Series) -> list[np.ndarray]:
    """Return the frames of each stretch in which there should be no alarm."""
    frames = np.flatnonzero(series.time < window(series.label)[0])
    parts = round(len(frames) / series.rate / WINDOW)
    return np.array_split(frames, parts) if parts else []


def choose(counts: Sequence[Counts]) -> tuple[int, int]:
    """Return the indices of persistence and threshold that do best on some clips."""
    approaches = max(sum(each.is_approach for each in counts), 1)
    stretches = max(sum(each.negative_segments for each in counts), 1)
    hits = np.sum([each.hits & each.is_approach for each in counts], axis=0) / approaches
    merit = hits - np.sum([each.alarmed for each in counts], axis=0) / stretches
    is_best = merit >= merit.max() - LEVEL
    ranges = [(length, -row, row, start) for row, line in enumerate(is_best) for start, length in _runs(line)]
    length, _, row, start = max(ranges)
    return row, start + (length - 1) // 2


def _runs(line: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """Return start and length of every run of true values.

    >>> _runs(np.array([True, False, True, True]))
    [(0, 1), (2, 2)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
    return [(int(start), int(end - start)) for start, end in edges.reshape(-1, 2)]


def split_halves(labels: Sequence[Label]) -> tuple[list[int], list[int]]:
    """Return the indices of two halves, each with every second clip of those that approach and of the others."""
    order = sorted(range(len(labels)), key=lambda k: (not labels[k].is_approach, labels[k].kind, labels[k].clip))
    return order[::2], order[1::2]


def summarise(counts: Sequence[Counts], settings: Iterable[tuple[int, int]]) -> Outcome:
    """Return the scores of clips, each with its own setting."""
    chosen = list(zip(counts, settings, strict=True))
    approaches = sum(each.is_approach for each in counts)
    hits = sum(bool(each.hits[k]) for each, k in chosen if each.is_approach)
    false_alarms = int(sum(each.false_alarms[k] for each, k in chosen))
    minutes = sum(each.minutes for each in counts)
    leads = np.asarray([each.leads[k] for each, k in chosen if np.isfinite(each.leads[k])])
    unknown = metrics.Estimate(value=np.nan, low=np.nan, high=np.nan)
    return Outcome(
        hits=hits,
        approaches=approaches,
        hit_rate=metrics.wilson_proportion(hits, approaches),
        false_alarms=false_alarms,
        minutes=minutes,
        false_alarms_a_minute=metrics.poisson_rate(false_alarms, minutes) if minutes > 0 else unknown,
        lead=metrics.bootstrap_mean(leads) if len(leads) else unknown,
    )


def area(series: Sequence[Series]) -> float | None:
    """Return the area under ROC; None without both windows and stretches."""

    def largest(parts: Callable[[Series], Iterable[np.ndarray]]) -> list[float]:
        return [float(each.response[part].max()) for each in series for part in parts(each) if len(part)]

    positive, negative = largest(_windows), largest(_stretches)
    if not positive or not negative:
        return None
    return metrics.area_under_roc(positive, negative)


def _windows(series: Series) -> list[np.ndarray]:
    low, high = window(series.label)
    return [np.flatnonzero((series.time >= low) & (series.time <= high))] if series.label.is_approach else []


def peak_is_at_contact(series: Series) -> bool:
    """Return whether the largest response of the whole clip is close to contact; no alarm can know that in time."""
    contact = series.label.contact
    return contact is not None and bool(abs(series.time[np.argmax(series.response)] - contact) <= PEAK_TOLERANCE)


def roc(counts: Sequence[Counts], persistence: int) -> JsonObject:
    """Return hit rate and share of stretches with a false alarm for every threshold, at one persistence."""
    approaches = sum(each.is_approach for each in counts)
    stretches = max(sum(each.negative_segments for each in counts), 1)
    hits = np.sum([each.hits[persistence] & each.is_approach for each in counts], axis=0)
    alarmed = np.sum([each.alarmed[persistence] for each in counts], axis=0)
    return {"hit_rate": (hits / approaches).tolist(), "stretches_with_alarm": (alarmed / stretches).tolist()}
