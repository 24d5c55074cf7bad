from . import collision_causes as collision_causes
from . import contacts as contacts
from . import gait_test as gait_test
from . import metrics as metrics
from . import run_trial as run_trial
from . import settings as settings
from . import trials as trials
