"""How much of its picture should each LGMD look at?

`python experiments/overlap.py --help`.
"""

import sys

import tyro

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import overlap

    sys.exit(guarded(lambda: tyro.cli(overlap.main)))
