"""Can the gait be fitted through the body, by gradient through the physics?

`python experiments/stride.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("stride")))
