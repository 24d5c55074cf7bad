"""The robot as an environment of reinforcement learning: pure functions in JAX, and Gymnasium's interface.

Importing this wing registers `lgmdjax/Hexapod-v0` where Gymnasium is installed (extra `gym`).
"""

from importlib.util import find_spec

import lazy_loader

if find_spec("gymnasium") is not None:
    import gymnasium

    if "lgmdjax/Hexapod-v0" not in gymnasium.registry:
        gymnasium.register(
            id="lgmdjax/Hexapod-v0",
            entry_point="lgmdjax.environments.gym_env:HexapodEnv",
            vector_entry_point="lgmdjax.environments.gym_env:HexapodVectorEnv",
        )

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
