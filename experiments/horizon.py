"""How far back is a derivative of the closed loop worth taking?

`python experiments/horizon.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("horizon")))
