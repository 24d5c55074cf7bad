"""What do the equations do that cannot work as printed?

`python experiments/printed.py --help`; 10 minutes on two cores.
"""

import tyro

from lgmdjax.cli import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    tyro.cli(alone.command("printed"))
