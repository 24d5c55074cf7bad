"""How well looming detectors distinguish approach from everything else, on laboratory stimuli.

| score       | meaning                                                                                               |
| ----------- | ----------------------------------------------------------------------------------------------------- |
| peaks       | largest u - 0.5 in each clip, from the third frame on                                                 |
| selectivity | peak of a clip, over the mean peak of the approaches of a dark square                                 |
| auc_dark    | area under ROC: peaks of the dark and the textured approaches against those of what does not approach |
| auc_bright  | the same for the approaches of a bright square                                                        |
| timing      | time of the peak before contact, and the line through it: slope l/|v| + intercept, with r             |
| contrast    | peak of an approach, by contrast                                                                      |
| noise       | peak of an approach and of a still image, by the standard deviation of the noise                      |

A detector of a fixed delay delta and angular threshold theta_t has slope 1 / tan(theta_t / 2) and intercept -delta
(Gabbiani et al. 1999). Detectors have their published constants; cells of the fly's detectors are about 5 degrees wide.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lgmdjax.detectors import (
    d_lgmd,
    dsn,
    emd,
    eta,
    grm,
    lgmd,
    lgmd1_grouping,
    lgmd1_onoff,
    lgmd2,
    lplc2,
    protocol,
    tau,
)
from lgmdjax.errors import InputError
from lgmdjax.evaluation import metrics, stimulus_clips
from lgmdjax.evaluation.settings import StimulusBench
from lgmdjax.evaluation.stimulus_clips import CONTRASTS, NOISE, Clips
from lgmdjax.runtime import user_objects
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.sensors import camera

FIRST = 2  # frames in which a detector settles
SILENT = 1e-3  # peak below which a response counts as none, and has no time
FLY_CELL = np.radians(5.0)  # width of a cell of the fly's detectors
OTHERS = ("recede", "translate", "elongate", "grating", "yaw", "sway", "flash")  # what does not approach


class DetectorSetup(NamedTuple):
    """A detector, its parameters for an eye, and whether it gets the geometry instead of frames."""

    detector: protocol.Detector
    params: Callable[[camera.Params], PyTree]
    is_ideal: bool = False
    own_hemifield: Callable[[], PyTree] | None = None

    def hemifield(self) -> PyTree:
        """Return its published parameters for a robot's eye: one half of the view, the outermost column first."""
        return self.detector.Params() if self.own_hemifield is None else self.own_hemifield()


class StimulusClips(NamedTuple):
    """All clips of a benchmark."""

    selection: Clips
    timing: Clips
    contrast: Clips
    noise: Clips


def _published(detector: Any, is_ideal: bool = False) -> DetectorSetup:
    return DetectorSetup(detector, lambda _: detector.Params(), is_ideal)


def _correlators(eye: camera.Params) -> emd.Params:
    return emd.Params(pooling=max(round(float(FLY_CELL) * eye.width / eye.fov), 1))


DETECTORS: Mapping[str, DetectorSetup] = {
    "lgmd": _published(lgmd),
    "lgmd1_grouping": _published(lgmd1_grouping),
    "lgmd1_onoff": _published(lgmd1_onoff),
    "lgmd2": _published(lgmd2),
    "d_lgmd": _published(d_lgmd),
    "dsn": _published(dsn),
    "emd": DetectorSetup(emd, _correlators),
    "grm": DetectorSetup(
        grm, lambda eye: grm.Params(motion=_correlators(eye)), own_hemifield=lambda: grm.Params(hemifield=True)
    ),
    "lplc2": DetectorSetup(lplc2, lambda eye: lplc2.Params(motion=_correlators(eye))),
    "eta": _published(eta, is_ideal=True),
    "tau": _published(tau, is_ideal=True),
}
"""Detectors by name. Their time constants are for 30 frames a second."""


def get_detector(name: str) -> DetectorSetup:
    """Return a detector by its name here, by `module:attribute`, or by `module:` for a module that is a detector.

    >>> get_detector("lgmdjax.detectors:lgmd2").detector.__name__
    'lgmdjax.detectors.lgmd2'
    """
    if name in DETECTORS:
        return DETECTORS[name]
    expected = f"expected a detector among {', '.join(DETECTORS)}, or module:attribute"
    detector = user_objects.find(name, expected)
    missing = [part for part in ("Params", "init", "step") if not hasattr(detector, part)]
    if missing:
        raise InputError(f"{expected}, got {name} without {', '.join(missing)}; see protocol.Detector")
    return _published(detector)


def choose_seeing(given: Sequence[str], own: Sequence[str] = ()) -> list[str]:
    """Return the names of detectors that see pictures; "all" means all of this package, after those in `own`.

    Raises InputError for an unknown one and for an ideal observer, before any work begins.
    """
    seeing = [*own, *(name for name, setup in DETECTORS.items() if not setup.is_ideal)]
    names = list(dict.fromkeys(name for each in given for name in (seeing if each == "all" else [each])))
    for name in names:
        if name not in own and get_detector(name).is_ideal:
            raise InputError(
                f"expected a detector that sees, got {name}, which is given the geometry of one object; "
                f"choose from {', '.join(seeing)}, or module:attribute"
            )
    return names


def render_clips(settings: StimulusBench, seed: int) -> StimulusClips:
    """Render all clips."""
    return StimulusClips(
        selection=stimulus_clips.selection(settings),
        timing=stimulus_clips.timing(settings),
        contrast=stimulus_clips.contrast(settings),
        noise=stimulus_clips.noise(settings, seed),
    )


def score(name: str, clips: StimulusClips) -> JsonObject:
    """Run a detector on all clips and return its scores."""
    setup = get_detector(name)
    height, width = clips.selection.frames.shape[2:]
    params = setup.params(camera.Params(width=width, height=height))
    u = {part: respond(setup, params, some) for part, some in clips._asdict().items()}
    peaks = {part: np.max(response[:, FIRST:], axis=1) for part, response in u.items()}
    named = dict(zip(clips.selection.names, peaks["selection"].tolist(), strict=True))
    return {
        "detector": name,
        "is_ideal": setup.is_ideal,
        "peaks": named,
        **compare(named),
        "timing": time_peaks(u["timing"], clips.timing),
        "contrast": {"contrasts": list(CONTRASTS), "peaks": peaks["contrast"].tolist()},
        "noise": {
            "sigma": list(NOISE),
            "approach": peaks["noise"][::2].tolist(),
            "still": peaks["noise"][1::2].tolist(),
        },
    }


def respond(setup: DetectorSetup, params: PyTree, clips: Clips) -> Float[np.ndarray, "clips frames"]:
    """Return u - 0.5 for every frame after the first of every clip."""
    inputs = clips.geometry if setup.is_ideal else jnp.asarray(clips.frames, float)
    return np.asarray(_respond(setup.detector.init, setup.detector.step, params, inputs)) - 0.5


@partial(jax.jit, static_argnums=(0, 1))
def _respond(init: Callable[..., PyTree], step: Callable[..., Any], params: PyTree, inputs: PyTree) -> Array:
    def one(clip: PyTree) -> Array:
        start = init(params, jax.tree.map(lambda leaf: leaf[0], clip))
        rest = jax.tree.map(lambda leaf: leaf[1:], clip)

        def advance(state: PyTree, frame: PyTree) -> tuple[PyTree, Array]:
            state, response = step(params, state, frame)
            return state, response.u

        return jax.lax.scan(advance, start, rest)[1]

    return jax.vmap(one)(inputs)


def compare(peaks: Mapping[str, float]) -> JsonObject:
    """Return selectivity and both areas under ROC from the peak of each clip.

    >>> peaks = {"approach dark 1 s": 0.4, "approach bright 1 s": 0.1, "recede dark 1 s": 0.2, "flash": 0.0}
    >>> scores = compare(peaks)
    >>> scores["auc_dark"], scores["auc_bright"], scores["selectivity"]["flash"]
    (1.0, 0.5, 0.0)
    """
    dark, bright, textured = (_matching(peaks, f"approach {kind}") for kind in ("dark", "bright", "textured"))
    others = [peak for kind in OTHERS for peak in _matching(peaks, kind)]
    mean = float(np.mean(dark))
    selectivity = {name: peak / mean if mean > SILENT else None for name, peak in peaks.items()}
    return {
        "selectivity": selectivity,
        "auc_dark": metrics.area_under_roc(dark + textured, others),
        "auc_bright": metrics.area_under_roc(bright, others),
    }


def time_peaks(response: Float[np.ndarray, "clips frames"], clips: Clips) -> JsonObject:
    """Return the time of each peak before contact [s], None without a response, and the line through them."""
    l_over_v = [float(name) for name in clips.names]
    before: list[float | None] = []
    for u in response:
        peak = FIRST + int(np.argmax(u[FIRST:]))
        before.append(0.0 - float(clips.time[1 + peak]) if u[peak] > SILENT else None)
    seen = [(x, y) for x, y in zip(l_over_v, before, strict=True) if y is not None]
    slope, intercept, r = _line(*np.transpose(seen)) if len(seen) > 2 else (None, None, None)
    return {"l_over_v": l_over_v, "before_contact": before, "slope": slope, "intercept": intercept, "r": r}


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float | None]:
    """Return slope, intercept and correlation; the correlation of a level line is None."""
    slope, intercept = np.polyfit(x, y, 1)
    r = float(np.corrcoef(x, y)[0, 1]) if np.ptp(y) > 0 else None
    return float(slope), float(intercept), r


def _matching(peaks: Mapping[str, float], kind: str) -> list[float]:
    return [peak for name, peak in peaks.items() if name.startswith(kind)]
