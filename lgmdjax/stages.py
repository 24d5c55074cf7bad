"""The stages of `lgmdjax reproduce`, in order: what each reads, does and writes.

Every stage is a function of the folder that it writes into, the finished folders of its inputs by name, its
settings (`lgmdjax.scales`) and the run's seed; `lgmdjax.runs` decides when it runs and moves its files into
place. A folder may hold what an interrupted try left there, which a stage carries on from or overwrites.
Heavy modules are imported inside.
"""

from collections.abc import Mapping
from pathlib import Path

from lgmdjax import scales
from lgmdjax.runs import Stage


def fit_gait(folder: Path, inputs: Mapping[str, Path], settings: scales.FitGait, seed: int) -> None:
    """Teach the shaping networks the regular tripod gait."""
    raise NotImplementedError


def collect(folder: Path, inputs: Mapping[str, Path], settings: scales.Collect, seed: int) -> None:
    """Walk the teacher through training rooms and record what both eyes say beside what the laser sees."""
    raise NotImplementedError


def train(folder: Path, inputs: Mapping[str, Path], settings: scales.Train, seed: int) -> None:
    """Fit the navigator to the recorded walks, and those it is compared with."""
    raise NotImplementedError


def evaluate(folder: Path, inputs: Mapping[str, Path], settings: scales.Evaluate, seed: int) -> None:
    """Walk all drivers through rooms that none of them has seen, on the same seeds."""
    raise NotImplementedError


def report(folder: Path, inputs: Mapping[str, Path], settings: scales.Report, seed: int) -> None:
    """Draw the figures and the video, and write the page."""
    raise NotImplementedError


STAGES = (
    Stage(name="fit-gait", work=fit_gait),
    Stage(name="collect", work=collect, inputs=("fit-gait",)),
    Stage(name="train", work=train, inputs=("collect",)),
    Stage(name="evaluate", work=evaluate, inputs=("fit-gait", "train")),
    Stage(name="report", work=report, inputs=("fit-gait", "collect", "train", "evaluate")),
)
