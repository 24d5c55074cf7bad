from . import cube_camera as cube_camera
from . import robot_model as robot_model
from . import faults as faults
from . import nerves as nerves
from . import walk as walk
