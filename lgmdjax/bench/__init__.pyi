from . import closed_loop as closed_loop
from . import cost as cost
from . import fitting as fitting
from . import settings as settings
from . import summary as summary
from . import tables as tables
from . import teacher_walks as teacher_walks
from . import worlds as worlds
