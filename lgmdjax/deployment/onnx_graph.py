"""The nervous system as an ONNX graph, written by jax2onnx, which the extra `onnx` installs.

Inputs are the pictures and each array of the state, outputs `targets`, `u`, `velocity`, and each array of the next
state with `next_` before its name.
"""

from importlib.util import find_spec
from pathlib import Path

import jax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array

from lgmdjax.deployment import nervous_system
from lgmdjax.deployment.nervous_system import Params
from lgmdjax.errors import InputError

if HAS_JAX2ONNX := find_spec("jax2onnx") is not None:
    import onnx  # pyright: ignore[reportMissingImports]
    import onnx_ir  # pyright: ignore[reportMissingImports]
    from jax2onnx import to_onnx  # pyright: ignore[reportMissingImports]
    from onnx_ir.passes import common as passes  # pyright: ignore[reportMissingImports]

FILE = "nervous_system.onnx"
OPSET = 18  # of 2022; onnxruntime 1.14 and newer run it


def check_installed() -> None:
    """Raise `InputError` if jax2onnx is missing."""
    if not HAS_JAX2ONNX:
        raise InputError(
            f"expected jax2onnx to write {FILE}, got an environment without it; pip install 'lgmdjax[onnx]' in an "
            "environment of its own, or leave it out: --formats stablehlo c"
        )


def write(folder: Path, params: Params) -> None:
    """Write the graph, with the parameters as its constants, into a folder."""
    check_installed()
    # jax2onnx converts a traced program, but fails on modules of flax inside `vmap`.
    traced = jax.make_jaxpr(nervous_system.by_name(params))(*nervous_system.argument_types(params))
    inputs, outputs = io_names(params)
    values = [id(variable) for variable in traced.jaxpr.outvars]
    first = [values.index(value) for value in values]  # jax2onnx returns an array with two names only once

    def distinct(*leaves: Array) -> list[Array]:
        return [leaf for index, leaf in enumerate(jaxpr_as_fun(traced)(*leaves)) if first[index] == index]

    graph = to_onnx(
        distinct,
        inputs=[jax.ShapeDtypeStruct(value.shape, value.dtype) for value in traced.in_avals],
        model_name="nervous_system",
        opset=OPSET,
        input_names=inputs,
        output_names=[name for index, name in enumerate(outputs) if first[index] == index],
        return_mode="ir",
    )
    for simplify in (
        passes.LiftSubgraphInitializersToMainGraphPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
    ):
        simplify(graph)
    model = onnx_ir.to_proto(graph)
    _name_outputs(model, [(outputs[k], outputs[first[k]], aval.shape) for k, aval in enumerate(traced.out_avals)])
    onnx.checker.check_model(model, full_check=True)
    (folder / FILE).write_bytes(model.SerializeToString())


def io_names(params: Params) -> tuple[list[str], list[str]]:
    """Return the names of inputs and outputs, in the order of the arguments and results of `nervous_system.by_name`."""
    function, types = nervous_system.by_name(params), nervous_system.argument_types(params)
    output, state = jax.eval_shape(function, *types)
    return ["pictures", *sorted(state)], [*sorted(output), *(f"next_{name}" for name in sorted(state))]


def _name_outputs(model: "onnx.ModelProto", outputs: list[tuple[str, str, tuple[int, ...]]]) -> None:
    """Give each output its shape, and a name of its own where it is a copy of another one: (name, source, shape)."""
    present = {value.name: value for value in model.graph.output}
    types = {name: present[source].type.tensor_type.elem_type for name, source, _ in outputs}
    del model.graph.output[:]
    for name, source, shape in outputs:
        model.graph.output.append(onnx.helper.make_tensor_value_info(name, types[name], shape))
        if name != source:
            model.graph.node.append(onnx.helper.make_node("Identity", [source], [name]))
