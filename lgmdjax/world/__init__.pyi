from . import arena as arena
from . import floor_plan as floor_plan
from . import obstacles as obstacles
from . import raycast as raycast
from . import scenes as scenes
from . import texture as texture
