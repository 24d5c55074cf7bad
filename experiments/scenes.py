"""Figs. 15 and 16: indoors, outdoors, and things put in the way.

`python experiments/scenes.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.compare("indoor", "outdoor", "dynamic")))
