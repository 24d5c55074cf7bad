from . import doctor as doctor
from . import environment as environment
from . import flags as flags
from . import main as main
from . import study as study
from . import trial as trial
from . import watch as watch
