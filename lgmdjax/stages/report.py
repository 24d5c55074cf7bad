"""Stage report: draw the figures and the film, and write the page."""

from collections.abc import Mapping
from pathlib import Path

from lgmdjax import report, scales


def work(folder: Path, inputs: Mapping[str, Path], settings: scales.Report, seed: int) -> None:
    """Write index.html from the folders of all stages before."""
    report.render(folder.parent, folder, video_seconds=settings.video_seconds)
