"""A hexapod robot that avoids obstacles with two looming detectors, differentiable end to end in JAX.

`import lgmdjax as lj` gives the names below. Each is imported when it is first used, so that the import itself and
`lgmdjax --help` take no time.

| name | what |
| --- | --- |
| load_robot, random_rooms, rollout, run_trial | a robot, rooms, and walks of the one in the others |
| score, plot_walks, write_video, show_walk, walk_page | of walks: numbers, figure, video, in a notebook, in 3D |
| Record, Room, InputError | the types that they pass and the error that they raise |
| lgmd, cpg, camera, laser, navigator, braitenberg, hexapod | components: `init` and `step` of one agent |
| world, locomotion, body, sensors, detectors, control | the other modules of the robot and its rooms |
| simulation, deployment, transfer, hardware, reporting, evaluation, learning | what is done with them |
| datasets, environments, viewer, studies, pipeline, cli, runtime | for other libraries, in the browser, by commands |

>>> import jax
>>> import lgmdjax as lj
>>> rooms = lj.random_rooms(jax.random.key(0), 4)
>>> rooms.starts.shape  # x, y and yaw of 32 poses in each of 4 rooms
(4, 32, 3)
"""

import lazy_loader

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
