"""How far may eyes, room, legs and data be from those that were chosen?

`python experiments/sensitivity.py --help`.

Pupils of less data learn from the walks of a run: name one that is trained, `--run runs/quick-0`.
"""

import sys

from lgmdjax.cli import guarded, import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    sys.exit(guarded(lambda: alone.run("sensitivity")))
