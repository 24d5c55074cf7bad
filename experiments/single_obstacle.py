"""Fig. 14: a tube ahead, at fifteen distances to either side.

`python experiments/single_obstacle.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.compare("tube")))
