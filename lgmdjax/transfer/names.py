"""Names of the faults; free of JAX, for a fast command line."""

from typing import Literal, get_args

FaultName = Literal[
    "noise", "exposure", "vignetting", "blur", "jpeg", "drops", "latency", "rate", "lens", "turn", "gains",
    "backlash", "delay", "friction", "payload",
]  # fmt: skip
FAULT_NAMES: tuple[FaultName, ...] = get_args(FaultName)
