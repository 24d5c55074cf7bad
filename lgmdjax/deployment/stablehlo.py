"""The nervous system as StableHLO: a program that XLA compiles for CPU and CUDA, without this package.

`jax.export.deserialize(file.read_bytes()).call(pictures, state)` returns two dictionaries: the output, and the next
state, which has the names of the first one (`nervous_system.leaf_names`).
"""

from pathlib import Path

import jax
from jax import export

from lgmdjax.deployment import nervous_system
from lgmdjax.deployment.nervous_system import Params

FILE = "nervous_system.stablehlo"
PLATFORMS = ("cpu", "cuda")


def write(folder: Path, params: Params) -> None:
    """Write the program, with the parameters as its constants, into a folder."""
    function = jax.jit(nervous_system.by_name(params))
    exported = export.export(function, platforms=PLATFORMS)(*nervous_system.argument_types(params))
    (folder / FILE).write_bytes(exported.serialize())
