"""Settings of the stereo camera that a run, a study or a trial may change."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Image size per eye, and how the LGMD of each side samples it.

    A cell averages `pooling` x `pooling` pixels, about 6 degrees at every scale. With the default `overlap` the two
    LGMDs share no column of the images: both eyes see what is straight ahead and far away, and it does not tell the
    sides apart (`lgmdjax.studies.overlap`).
    """

    width: int
    """width of each eye's image [px]"""
    height: int
    """height of each eye's image [px]"""
    overlap: float = 0.5
    """fraction of the width that each LGMD receives, from its own side: 0.5 to 1"""
    ground: float = 0.0
    """fraction of the height, at the bottom, that no LGMD receives; 0.5 is all below the horizon"""
    falloff: float = 0.0
    """how much less the LGMDs weigh what is beside than what is ahead (`lgmdjax.detectors.lgmd`); 0 is not at all"""
    pooling: int = 1
    """width of a detector's cell [px]"""
