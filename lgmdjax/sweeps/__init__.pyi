from . import execution as execution
from . import results as results
from . import sweep_file as sweep_file
from . import task as task
