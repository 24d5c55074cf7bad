"""Sec. 3.4 and 4.2: which rule should teach, and what should learn?

`python experiments/teaching.py --help`.
"""

import sys

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.cli import study

    sys.exit(guarded(lambda: study.run("supervision")))
