"""Names of the formats; free of JAX, for a fast command line."""

from typing import Literal

Format = Literal["onnx", "stablehlo", "c"]
FORMATS: tuple[Format, ...] = ("onnx", "stablehlo", "c")
PRETRAINED = "pretrained"  # in place of a run folder: the robot that comes with the package
