"""Sec. 3.4 and 4.2: which rule should teach, and what should learn?

`python experiments/teaching.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("teaching")))
