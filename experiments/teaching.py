"""Sec. 3.4 and 4.2: which rule should teach, and what should learn?

`python experiments/teaching.py --help`; an hour on two cores.
"""

import tyro

from lgmdjax.cli import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    tyro.cli(alone.command("teaching"))
