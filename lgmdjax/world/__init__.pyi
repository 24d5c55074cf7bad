from . import arena as arena
from . import meshes as meshes
from . import mujoco_world as mujoco_world
from . import obstacles as obstacles
from . import photographs as photographs
from . import raycast as raycast
from . import scenes as scenes
from . import texture as texture
