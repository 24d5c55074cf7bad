"""What would a detector fitted by gradient be like, and would it steer better than the calibrated one?

`python experiments/detector.py --help`.
"""

import sys

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.cli import study

    sys.exit(guarded(lambda: study.run("lgmd_gradient")))
