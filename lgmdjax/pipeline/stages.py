"""The stages of `lgmdjax reproduce`, in order, each with its inputs.

A stage is a function `run(folder, inputs, settings, seed)`. It writes its files into `folder`, reads the finished
folders of its inputs by their names, and gets its settings (`lgmdjax.pipeline.scales`) and the run's seed.
`lgmdjax.runtime.run_folders` decides when a stage runs, and moves its files into place. The folder may hold files of an
interrupted attempt; a stage resumes from them or overwrites them. A stage without settings in a scale is left out, also
from the inputs of other stages.

Of several processes (`lgmdjax.runtime.distributed`) all run the stages that are `shared`; the first runs the others.
"""

from lgmdjax.pipeline import collect, evaluate, fit_gait, report, train
from lgmdjax.runtime.run_folders import Stage
from lgmdjax.studies import errata, failure_modes, sensitivity, supervision, velocity

_ROBOT = ("fit-gait", "collect", "train")
STUDIES = (
    Stage(name="velocity", run=velocity.run, inputs=_ROBOT),
    Stage(name="supervision", run=supervision.run, inputs=_ROBOT),
    Stage(name="errata", run=errata.run, inputs=_ROBOT),
    Stage(name="failure_modes", run=failure_modes.run, inputs=_ROBOT),
    Stage(name="sensitivity", run=sensitivity.run, inputs=_ROBOT),
)
STAGES = (
    Stage(name="fit-gait", run=fit_gait.run, inputs=("robot",)),  # of `lgmdjax.pipeline.robot`, if there is one
    Stage(name="collect", run=collect.run, inputs=("fit-gait",), shared=True),
    Stage(name="train", run=train.run, inputs=("fit-gait", "collect"), shared=True),
    Stage(name="evaluate", run=evaluate.run, inputs=_ROBOT, shared=True),
    *STUDIES,
    Stage(name="report", run=report.run, inputs=(*_ROBOT, "evaluate", *(study.name for study in STUDIES))),
)
