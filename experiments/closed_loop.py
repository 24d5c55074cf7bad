"""Does the gradient through the closed loop teach what imitation of recorded walks cannot?

`python experiments/closed_loop.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("closed_loop")))
