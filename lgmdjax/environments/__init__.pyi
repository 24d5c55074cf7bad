from . import commands as commands
from . import coverage as coverage
from . import functional as functional
from . import gym_env as gym_env
from . import rendering as rendering
from . import rewards as rewards
