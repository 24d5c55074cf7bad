"""The stages of `lgmdjax reproduce`, in order: what each reads, does and writes.

Every stage is a function of the folder that it writes into, the finished folders of its inputs by name, its
settings (`lgmdjax.pipeline.scales`) and the run's seed; `lgmdjax.runtime.run_folders` decides when it runs and moves
its files into place. A folder may hold what an interrupted try left there, which a stage carries on from or overwrites.
A stage that a scale has no settings for is left out, and is no input of others.
"""

from lgmdjax.pipeline import collect, evaluate, fit_gait, report, train
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.studies import errata, failure_modes, sensitivity, supervision, velocity

_BEFORE = ("fit-gait", "collect", "train")
STUDIES = (
    Stage(name="velocity", work=velocity.work, inputs=_BEFORE),
    Stage(name="supervision", work=supervision.work, inputs=_BEFORE),
    Stage(name="errata", work=errata.work, inputs=_BEFORE),
    Stage(name="failure_modes", work=failure_modes.work, inputs=_BEFORE),
    Stage(name="sensitivity", work=sensitivity.work, inputs=_BEFORE),
)
STAGES = (
    Stage(name="fit-gait", work=fit_gait.work),
    Stage(name="collect", work=collect.work, inputs=("fit-gait",)),
    Stage(name="train", work=train.work, inputs=("fit-gait", "collect")),
    Stage(name="evaluate", work=evaluate.work, inputs=_BEFORE),
    *STUDIES,
    Stage(name="report", work=report.work, inputs=(*_BEFORE, "evaluate", *(study.name for study in STUDIES))),
)
