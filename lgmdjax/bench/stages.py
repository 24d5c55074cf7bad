"""Stages that every comparison of detectors has: walks of the teacher, and one for each detector, which reads them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

from lgmdjax.bench import teacher_walks
from lgmdjax.detectors import protocol
from lgmdjax.evaluation import stimulus_scores
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.simulation import assembly, closed_loop

OWN = "robot"  # the robot's own LGMD
WALKS, SCORES = "walks", "scores"
Size = TypeVar("Size")


@dataclass(frozen=True, kw_only=True)
class StageSettings(Generic[Size]):
    """What the files of a stage depend on."""

    robot: str  # its fingerprint
    size: Size  # settings of the comparison
    detector: str = ""  # its name
    source: str = ""  # what distinguishes it from others (`protocol.identify`)


Run = Callable[[closed_loop.Params, Path, Mapping[str, Path], StageSettings[Size], int], None]
"""What a stage does, from the robot, its folder, the folders of its inputs, its settings and the seed."""


def plan(
    robot: closed_loop.Params, names: Sequence[str], size: Size, record: Run[Size], work: Run[Size]
) -> tuple[list[Stage], dict[str, StageSettings[Size]]]:
    """Return the stage `WALKS`, one for each detector, which works on these walks, and the settings of all.

    Args:
        robot: the robot that walks.
        names: of the detectors, `OWN` for the robot's.
        size: settings of the comparison.
        record: what stage `WALKS` does.
        work: what the stage of a detector does.
    """
    base = StageSettings(robot=assembly.fingerprint(robot), size=size)
    stages, settings = [Stage(name=WALKS, run=partial(record, robot))], {WALKS: base}
    for name in names:
        stages.append(Stage(name=teacher_walks.stage_name(name), run=partial(work, robot), inputs=(WALKS,)))
        source = name if name == OWN else protocol.identify(stimulus_scores.get_detector(name).detector)
        settings[stages[-1].name] = replace(base, detector=name, source=source)
    return stages, settings
