from . import bench as bench
from . import doctor as doctor
from . import export as export
from . import flags as flags
from . import main as main
from . import study as study
from . import trial as trial
from . import watch as watch
