"""Sec. 5.4: a white wall and a corner, and what helps.

`python experiments/failures.py --help`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("failures")))
