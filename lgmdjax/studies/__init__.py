"""What the paper says of its robot, and what a user needs to know to build another: a study a claim.

| study       | paper            | question                                                               |
| ----------- | ---------------- | ---------------------------------------------------------------------- |
| velocity    | sec. 4.2, fig. 9 | how fast should the robot walk for its eyes?                           |
| teaching    | sec. 3.4, 4.2    | which rule should teach, and what should learn?                        |
| printed     | -                | what do the equations do that cannot work as printed?                  |
| failures    | sec. 5.4         | how often do a white wall and a corner stop it, and what helps?        |
| sensitivity | -                | how far may eyes, room, legs and data be from those that were chosen?  |

Each is a stage of `lgmdjax reproduce --scale paper`: `work(folder, inputs, settings, seed)` writes <study>.json, rows
of numbers, and keeps what it walked, so that it carries on after an interruption; `draw` makes a figure of the rows.
Robots are compared in the rooms of `crew.benched`.
"""
