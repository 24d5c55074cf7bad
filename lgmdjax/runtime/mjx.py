"""MJX, imported without the two lines that it prints if its optional back end (Warp) is not installed."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx as mjx
    from mujoco.mjx._src.collision_driver import geom_pairs as geom_pairs
    from mujoco.mjx._src.solver import Context as Context

__all__ = ["Context", "geom_pairs", "mjx"]
