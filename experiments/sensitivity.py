"""How far may eyes, room, legs and data be from those that were chosen?

`python experiments/sensitivity.py --help`.

Pupils of less data learn from the walks of a run: name one that is trained, `--run runs/quick-0`.
"""

import sys

from lgmdjax.cli.main import guarded
from lgmdjax.runtime.jax_setup import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.cli import study

    sys.exit(guarded(lambda: study.run("sensitivity")))
