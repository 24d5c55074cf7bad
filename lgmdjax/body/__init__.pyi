from . import custom_robot as custom_robot
from . import hexapod as hexapod
from . import implicit_step as implicit_step
from . import robot_xml as robot_xml
from . import servo_faults as servo_faults
