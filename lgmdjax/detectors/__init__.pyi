from . import cells as cells
from . import lgmd as lgmd
from . import lgmd1_grouping as lgmd1_grouping
from . import lgmd1_onoff as lgmd1_onoff
from . import lgmd2 as lgmd2
from . import on_off as on_off
