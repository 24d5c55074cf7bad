"""A hexapod robot that avoids obstacles with two looming detectors, differentiable end to end in JAX.

`import lgmdjax as lj` gives the names below. Each is imported when it is first used, so the import itself and
`lgmdjax --help` are fast.

| name | what |
| --- | --- |
| load_robot, random_rooms, rollout, run_trial | a robot, rooms, walks of the robot in the rooms, a trial |
| score, plot_walks, write_video, show_walk, walk_page | walks as metrics, figure, video, in a notebook, in 3D |
| Record, Room, InputError | types that these functions pass, and the error that they raise |
| lgmd, cpg, camera, laser, navigator, braitenberg, hexapod | components of one robot, each with `init` and `step` |
| world, locomotion, body, sensors, detectors, control | the other modules of the robot and its rooms |
| simulation, deployment, transfer, hardware, reporting, evaluation, learning | what is done with the robot |
| datasets, environments, viewer, studies, bench | other libraries, browser, questions and comparisons |
| pipeline, cli, runtime | commands, files |

>>> import jax
>>> import lgmdjax as lj
>>> rooms = lj.random_rooms(jax.random.key(0), 4)
>>> rooms.starts.shape  # x, y and yaw of 32 poses in each of 4 rooms
(4, 32, 3)
"""

import lazy_loader

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
