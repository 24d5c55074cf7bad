"""Recorded walks of a folder, whole or cut into episodes without a gap."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from lgmdjax.errors import InputError
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import episodes
from lgmdjax.simulation.episodes import Walk

PLACES = (".", "collect/episodes", "trial")
"""Where the walks are: in a folder of walks, in a run folder (the teacher's), in the folder of a trial."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Walks, and what the header of their files says."""

    folder: Path  # of the files
    walks: list[Walk]
    header: JsonObject

    @property
    def parameters(self) -> JsonObject:
        """JSON values with which the walks were recorded."""
        return self.header["parameters"]


def read(run: Path) -> Recording:
    """Return the recorded walks of a run folder (its teacher's), of a trial's folder, or of any folder of walks.

    Raises InputError for a folder without recorded walks, and for damaged ones.
    """
    folders = [run / place for place in PLACES if episodes.has_chunks(run / place)]
    if not folders:
        raise InputError(
            f"expected a run folder with walks, or a folder with chunk-*.parquet, got {run} without; "
            "`lgmdjax collect` makes some"
        )
    folder = folders[0]
    return Recording(folder=folder, walks=episodes.read(folder), header=episodes.read_header(folder))


def cut_episodes(walks: list[Walk]) -> list[tuple[int, slice]]:
    """Return the number of the walk and the frames of each episode: from a start or reset to the next, while ok."""
    found = []
    for number, walk in enumerate(walks):
        changes = (np.diff(walk.ok) != 0) | (np.diff(walk.resets) != 0)
        bounds = [0, *(np.flatnonzero(changes) + 1).tolist(), len(walk)]
        spans = [slice(first, end) for first, end in pairwise(bounds)]
        found += [(number, span) for span in spans if walk.ok[span.start]]
    return found
