"""How far back is a derivative of the closed loop worth taking?

`python experiments/horizon.py --help`.
"""

import sys

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.cli import study

    sys.exit(guarded(lambda: study.run("gradient_horizon")))
