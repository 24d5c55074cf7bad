from . import braitenberg as braitenberg
from . import compass as compass
from . import controller as controller
from . import lstm as lstm
from . import names as names
from . import navigator as navigator
from . import policies as policies
