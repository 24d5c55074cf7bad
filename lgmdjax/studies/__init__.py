"""Studies: each answers one question about the robot, with a table and a figure.

| study                | paper            | question                                                                   |
| -------------------- | ---------------- | -------------------------------------------------------------------------- |
| velocity             | sec. 4.2, fig. 9 | At which velocity do the detectors best distinguish obstructed from free?  |
| supervision          | sec. 3.4, 4.2    | Which rule should be the teacher, and which network should learn?          |
| errata               | -                | What do the equations do that cannot work as printed?                      |
| failure_modes        | sec. 5.4         | How often do a white wall and a corner stop the robot, and what helps?     |
| sensitivity          | -                | How much may camera, detector, room, body and data change?                 |
| overlap              | -                | How wide should the field of view of each detector be?                     |
| gait_gradient        | -                | Can the gait be fitted by gradient through the physics?                    |
| lgmd_gradient        | eqs. 9-16        | Is a detector fitted by gradient better than the calibrated one?           |
| gradient_horizon     | -                | Through how many frames is a gradient of the closed loop useful?           |
| closed_loop_finetune | -                | Does finetuning in the closed loop reduce collisions more than DAgger?     |
| transfer             | -                | Does the trained robot avoid obstacles in another engine?                  |

Each module has two functions. `run(folder, inputs, settings, seed)` writes <study>.json, a list of rows; it also keeps
the walks that it recorded, so that an interrupted study resumes. `plot(rows)` makes a figure of the rows. The first
five are stages of `lgmdjax reproduce --scale paper`; `lgmdjax study NAME` runs any of them. Robots are compared in the
rooms of `recording.record_benchmark`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
