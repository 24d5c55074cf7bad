"""Looming detectors compared: as the eyes of one robot, after a fit by gradient, and all results on one page.

| module        | content                                                            |
| ------------- | ------------------------------------------------------------------ |
| settings      | how many robots walk for how long, at each scale                   |
| closed_loop   | every detector steers the same robot: stages, from walks to scores |
| fitting       | constants of every detector, before and after a fit by gradient    |
| teacher_walks | walks of the teacher on which detectors are calibrated and fitted  |
| worlds        | the rooms, scenes and camera faults in which the robots are scored |
| cost          | time of a frame                                                    |
| tables        | scores as Markdown, CSV and LaTeX                                  |
| summary       | all results in one table and on one page                           |

Laboratory stimuli and labelled videos need no robot; they are in `lgmdjax.evaluation`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
