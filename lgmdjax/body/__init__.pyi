from . import hexapod as hexapod
from . import implicit_step as implicit_step
from . import robot_xml as robot_xml
