"""The stages of `lgmdjax reproduce`, in order: what each reads, does and writes.

Every stage is a function of the folder that it writes into, the finished folders of its inputs by name, its
settings (`lgmdjax.scales`) and the run's seed; `lgmdjax.runs` decides when it runs and moves its files into
place. A folder may hold what an interrupted try left there, which a stage carries on from or overwrites.
The work itself is in the modules beside this one, imported when it is wanted: they bring JAX and MuJoCo along.
"""

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from lgmdjax.runs import Stage, Work


def _later(module: str) -> Work:
    """Stand for the function `work` of a module that is imported on the first call."""

    def work(folder: Path, inputs: Mapping[str, Path], settings: Any, seed: int) -> None:
        import_module(f"lgmdjax.stages.{module}").work(folder, inputs, settings, seed)

    return work


STAGES = (
    Stage(name="fit-gait", work=_later("fit_gait")),
    Stage(name="collect", work=_later("collect"), inputs=("fit-gait",)),
    Stage(name="train", work=_later("train"), inputs=("fit-gait", "collect")),
    Stage(name="evaluate", work=_later("evaluate"), inputs=("fit-gait", "collect", "train")),
    Stage(name="report", work=_later("report"), inputs=("fit-gait", "collect", "train", "evaluate")),
)
