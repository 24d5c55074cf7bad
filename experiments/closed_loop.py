"""Does the gradient through the closed loop teach what imitation of recorded walks cannot?

`python experiments/closed_loop.py --help`.
"""

import sys

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.cli import study

    sys.exit(guarded(lambda: study.run("closed_loop_finetune")))
