"""Random rooms that nothing was learned or chosen in, all drivers compared.

`python experiments/unseen_rooms.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.compare("unseen")))
