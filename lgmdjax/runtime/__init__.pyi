from . import compiled_code as compiled_code
from . import export_cache as export_cache
from . import jax_setup as jax_setup
from . import mjx as mjx
from . import pytree_json as pytree_json
from . import run_folders as run_folders
from . import storage as storage
from . import versions as versions
