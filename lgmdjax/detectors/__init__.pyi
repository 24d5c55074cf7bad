from . import cells as cells
from . import lgmd as lgmd
from . import lgmd1_grouping as lgmd1_grouping
