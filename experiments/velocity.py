"""Fig. 9: how fast should the robot walk for its eyes?

`python experiments/velocity.py --help`; 6 minutes on two cores.
"""

import tyro

from lgmdjax.cli import import_physics, prepare_jax

if __name__ == "__main__":
    prepare_jax()
    import_physics()
    from lgmdjax.studies import alone

    tyro.cli(alone.command("velocity"))
