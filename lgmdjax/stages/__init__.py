"""The stages of `lgmdjax reproduce`, in order: what each reads, does and writes.

Every stage is a function of the folder that it writes into, the finished folders of its inputs by name, its
settings (`lgmdjax.scales`) and the run's seed; `lgmdjax.runs` decides when it runs and moves its files into
place. A folder may hold what an interrupted try left there, which a stage carries on from or overwrites.
The work itself is in the modules beside this one and in `lgmdjax.studies`, imported when it is wanted: they bring JAX
and MuJoCo along. A stage that a scale has no settings for is left out, and is no input of others.
"""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from lgmdjax.runs import Stage, Work


def _later(module: str) -> Work:
    """Stand for the function `work` of a module that is imported on the first call."""

    def work(folder: Path, inputs: Mapping[str, Path], settings: Any, seed: int) -> None:
        import_module(f"lgmdjax.{module}").work(folder, inputs, settings, seed)

    return work


_BEFORE = ("fit-gait", "collect", "train")
STUDIES = tuple(
    Stage(name=name, work=_later(f"studies.{name}"), inputs=_BEFORE)
    for name in ("velocity", "teaching", "printed", "failures", "sensitivity")
)
STAGES = (
    Stage(name="fit-gait", work=_later("stages.fit_gait")),
    Stage(name="collect", work=_later("stages.collect"), inputs=("fit-gait",)),
    Stage(name="train", work=_later("stages.train"), inputs=("fit-gait", "collect")),
    Stage(name="evaluate", work=_later("stages.evaluate"), inputs=_BEFORE),
    *STUDIES,
    Stage(
        name="report",
        work=_later("stages.report"),
        inputs=(*_BEFORE, "evaluate", *(study.name for study in STUDIES)),
    ),
)
