from . import cpg as cpg
from . import gait_fit as gait_fit
from . import kinematics as kinematics
from . import shaping as shaping
from . import tripod_gait as tripod_gait
