"""Settings of the stereo camera that a run, a study or a trial may change."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Pictures of width x height pixels an eye, of which each LGMD gets the part `overlap` on its side.

    Its cells look at `pooling` pixels a side: about 6 degrees at every scale. The two share no column of the picture:
    what both eyes see, which is what stands straight ahead, far off, tells neither side from the other
    (`experiments/overlap.py`).
    """

    width: int
    height: int
    overlap: float = 0.5
    pooling: int = 1
