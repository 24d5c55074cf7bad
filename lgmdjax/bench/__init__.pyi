from . import closed_loop as closed_loop
from . import cost as cost
from . import settings as settings
from . import tables as tables
from . import worlds as worlds
