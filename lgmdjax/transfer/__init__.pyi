from . import cube_camera as cube_camera
from . import faults as faults
from . import names as names
from . import nervous_systems as nervous_systems
from . import randomisation as randomisation
from . import robot_model as robot_model
from . import walk as walk
