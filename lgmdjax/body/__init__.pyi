from . import hexapod as hexapod
from . import implicit_step as implicit_step
from . import servo_faults as servo_faults
