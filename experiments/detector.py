"""What would a detector fitted by gradient be like, and would it steer better than the calibrated one?

`python experiments/detector.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("detector")))
