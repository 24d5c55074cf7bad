"""The nervous system as C99: one file without allocation and without any library but libm, and its header.

The two templates of this wing hold the functions, with the names and equations of the Python modules; this module fills
in sizes and parameters. It computes nothing; it only changes the layout of arrays, so that inner loops read memory in
order.
"""

from dataclasses import dataclass

import jax
import jinja2
import numpy as np
from jaxtyping import Array

from lgmdjax import __version__
from lgmdjax.control import navigator, policies
from lgmdjax.deployment import nervous_system
from lgmdjax.deployment.nervous_system import Params
from lgmdjax.detectors import cells, lgmd
from lgmdjax.errors import InputError, one_line
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.paths import PACKAGE_DIR
from lgmdjax.sensors import hemifield
from lgmdjax.simulation.closed_loop import FRAME_RATE, SUBSTEPS

FILES = ("nervous_system.h", "nervous_system.c")
GATES = 4  # input, forget, cell, output
LINE_LENGTH = 118
Value = Array | np.ndarray | float
Rows = list[tuple[str, Value, str]]  # name, value, comment


@dataclass(frozen=True, kw_only=True)
class Constant:
    """A number or a table of the program, and what its comment says: symbol, unit, equation, axes."""

    name: str
    value: Value
    comment: str

    @property
    def is_table(self) -> bool:
        return np.ndim(self.value) > 0

    def declaration(self) -> str:
        """Return the declaration in C: of a number with its value, of a table without.

        >>> print(Constant(name="THRESHOLD", value=0.1, comment="T_s, grey").declaration())
        static const float THRESHOLD = 0.1f;  /* T_s, grey */
        """
        value = "" if self.is_table else f" = {_number(np.float32(self.value))}"
        return f"static const float {self._dimensioned()}{value};  /* {self.comment} */"

    def definition(self) -> str:
        """Return a table with its numbers.

        >>> print(Constant(name="BASE", value=np.ones(2), comment="").definition())
        static const float BASE[2] = {1.0f, 1.0f};
        """
        return f"static const float {self._dimensioned()} = {_braces(np.asarray(self.value, np.float32), '')};"

    def _dimensioned(self) -> str:
        return self.name + "".join(f"[{length}]" for length in np.shape(self.value))


def generate(params: Params, robot: str) -> dict[str, str]:
    """Return the text of each file by name.

    Args:
        params: of the nervous system.
        robot: name of its robot, for the first comment.

    Raises InputError for forms of the components that the C program does not support.
    """
    _check(params)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(PACKAGE_DIR / "deployment" / "templates"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    contents = {
        "version": __version__,
        "robot": _in_comment(robot),
        "frame_rate": int(FRAME_RATE),
        "sizes": sizes(params),
        "private": private_sizes(params),
        "constants": constants(params),
        "efference": params.controller.policy.variant == "lstm-efference",
    }
    return {name: environment.get_template(f"{name}.j2").render(contents) for name in FILES}


def _in_comment(text: str) -> str:
    r"""Return a text, which may be any file name, so that it can stand in a comment of an ASCII file.

    >>> _in_comment("für */ elise")
    'f\\xfcr * / elise'
    """
    ascii_text = one_line(text).encode("ascii", "backslashreplace").decode()
    return ascii_text.replace("*/", "* /").replace("/*", "/ *")


def sizes(params: Params) -> dict[str, int]:
    """Return the sizes of the header's arrays, without their prefix."""
    rows, columns = nervous_system.cell_shape(params)
    views, units = jax.eval_shape(lambda: navigator.init(params.controller.policy)).hidden.shape
    return {
        "WIDTH": params.camera.width,
        "HEIGHT": params.camera.height,
        "SEEN_ROWS": hemifield.row_count(params.camera.height, params.camera.ground),
        "SEEN_COLUMNS": hemifield.column_count(params.camera.width, params.camera.overlap),
        "ROWS": rows,
        "COLUMNS": columns,
        "RADIUS": lgmd.KERNEL_RADIUS,
        "VIEWS": views,
        "UNITS": units,
        "SUBSTEPS": SUBSTEPS,
    }


def private_sizes(params: Params) -> dict[str, tuple[int, str]]:
    """Return the other sizes, and a comment on each."""
    seen, pooling = sizes(params), params.controller.detector.pooling
    _, row_parts = cells.pooling_parts(seen["SEEN_ROWS"], pooling)
    _, column_parts = cells.pooling_parts(seen["SEEN_COLUMNS"], pooling)
    inputs = params.controller.policy.weights["cell"]["dense_i"]["kernel"].shape[0]
    return {
        "LINE_PARTS": (row_parts * seen["ROWS"] // seen["SEEN_ROWS"], "in a line of pixels"),
        "ROW_PARTS": (row_parts, "in a row of cells"),
        "PIXEL_PARTS": (
            column_parts * seen["COLUMNS"] // seen["SEEN_COLUMNS"],
            "in the width of a pixel",
        ),
        "COLUMN_PARTS": (column_parts, "in the width of a cell"),
        "INPUTS": (inputs, "of the LSTM"),
        "CPG_STEPS": (params.controller.cpg.substeps, "Runge-Kutta steps for each move"),
        "SHAPING_UNITS": (shaping.UNITS, "of each shaping network"),
    }


def memory(params: Params) -> dict[str, int]:
    """Return the sizes of the state and of all constants [bytes], at 4 bytes a number."""
    size = sizes(params)
    pooled = size["ROWS"] * size["COLUMNS"]
    bordered = (size["ROWS"] + 2 * size["RADIUS"]) * (size["COLUMNS"] + 2 * size["RADIUS"])
    navigator_and_cpg = 2 * size["VIEWS"] * size["UNITS"] + 2 + 2 * cpg.LEGS * 2
    state = 2 * (pooled + bordered) + navigator_and_cpg + pooled + 1
    return {"state": 4 * state, "constants": 4 * sum(np.size(constant.value) for constant in constants(params))}


def constants(params: Params) -> list[Constant]:
    """Return all parameters, and the state at the start."""
    groups = (_lgmd_constants, _navigator_constants, _cpg_constants, _shaping_constants)
    return [Constant(name=name, value=value, comment=text) for group in groups for name, value, text in group(params)]


def _lgmd_constants(params: Params) -> Rows:
    detector = params.controller.detector
    _, columns = nervous_system.cell_shape(params)
    return [
        ("FRAME_RATE", FRAME_RATE, "Hz, of the camera"),
        ("THRESHOLD", detector.threshold, "T_s, grey (eq. 12)"),
        ("SUPPRESSION", detector.suppression, "T_f, grey (eq. 16)"),
        ("INHIBITION", detector.inhibition, "W_I (eq. 11)"),
        ("U_AT_REST", lgmd.U_AT_REST, "u without motion"),
        ("COLUMN_WEIGHTS", lgmd.column_weights(detector, columns), "w of each column of cells, the outermost first"),
        ("KERNEL", lgmd.kernel_quarter(detector.kernel), "w_I by distance in rows and columns (eq. 9)"),
    ]


def _navigator_constants(params: Params) -> Rows:
    policy, gait = params.controller.policy, policies.GAIT_RANGE
    cell, head = policy.weights["cell"], policy.weights["head"]
    return [
        ("INPUT_MEAN", policy.input_mean, "mean of u in the training data, by side"),
        ("INPUT_SCALE", policy.input_scale, "its standard deviation"),
        ("OUTPUT_MEAN", policy.output_mean, "mean of v in the training data, by side"),
        ("OUTPUT_SCALE", policy.output_scale, "its standard deviation"),
        ("INPUT_KERNEL", _by_gate(cell["dense_i"]["kernel"]), "weights of the inputs, by gate, input and unit"),
        ("HIDDEN_KERNEL", _by_gate(cell["dense_h"]["kernel"]), "weights of the memory, by gate, unit before and unit"),
        ("HIDDEN_BIAS", np.asarray(cell["dense_h"]["bias"]).reshape(GATES, -1), "of the gates, by gate and unit"),
        ("HEAD_KERNEL", np.asarray(head["kernel"]).T, "weights of the output, by side and unit"),
        ("HEAD_BIAS", head["bias"], "of the output, by side"),
        ("FIRST_VELOCITY", navigator.init(policy).velocity, "last velocity before the first picture"),
        ("MIN_VELOCITY", gait.min_velocity, "range of the gait, multiples of 0.05 m/s"),
        ("MAX_VELOCITY", gait.max_velocity, "the same"),
    ]


def _cpg_constants(params: Params) -> Rows:
    network = params.controller.cpg
    first = cpg.limit_cycle_state(network)
    mutual = -network.mutual_inhibition if network.printed_sign else network.mutual_inhibition
    return [
        ("REACTION_TIME", network.reaction_time, "T_r, time units"),
        ("ADAPTATION_TIME", network.adaptation_time, "T_a, time units"),
        ("SELF_INHIBITION", network.self_inhibition, "beta"),
        ("MUTUAL_INHIBITION", mutual, "w_fe"),
        ("COUPLING", network.coupling, "W, by inhibited and inhibiting leg"),
        ("TONIC", np.broadcast_to(network.tonic, (cpg.LEGS, 2)), "c_i, by leg and neuron"),
        ("CYCLE_TIME", network.cycle_time, "s"),
        ("NATURAL_PERIOD", network.natural_period, "time units for each cycle"),
        ("FIRST_ACTIVATION", first.activation, "on the limit cycle, by leg and neuron"),
        ("FIRST_ADAPTATION", first.adaptation, "the same"),
    ]


def _shaping_constants(params: Params) -> Rows:
    networks = params.controller.shaping
    first_layer = np.array(networks.w1)
    if networks.printed_input:
        first_layer[:, 1] = 0  # the adaptation difference, which these networks do not use
    return [
        ("SHAPING_W1", first_layer, "by leg, input (output, adaptation difference, velocity), unit"),
        ("SHAPING_B1", networks.b1, "by leg and unit"),
        ("SHAPING_W2", networks.w2, "by leg, unit and joint"),
        ("SHAPING_B2", networks.b2, "rad, by leg and joint"),
        ("LOWEST", params.limits[0], "rad, limits of the servos by leg and joint"),
        ("HIGHEST", params.limits[1], "the same"),
    ]


def _by_gate(kernel: Array) -> np.ndarray:
    """Return a kernel (from, gates x units) as (gates, from, units)."""
    return np.asarray(kernel).reshape(len(kernel), GATES, -1).swapaxes(0, 1)


def _check(params: Params) -> None:
    """Raise `InputError` for forms of the components that the C program does not support."""
    detector, policy = params.controller.detector, params.controller.policy
    if not policy.variant.startswith("lstm"):
        raise InputError(f"expected an LSTM as the navigator for C, got {policy.variant}; export other formats")
    if detector.smooth or detector.printed_feed_forward or detector.printed_gate:
        raise InputError(
            "expected an LGMD with hard thresholds and corrected equations for C, got another; export other formats"
        )
    private = {name: size for name, (size, _) in private_sizes(params).items()}
    if 255 * private["ROW_PARTS"] * private["COLUMN_PARTS"] >= 2**32:
        raise InputError(
            f"expected cells whose grey levels sum up in 32 bits, got {params.camera.height} rows for "
            f"{nervous_system.cell_shape(params)[0]} rows of cells; choose a --width of whole cells"
        )


def _number(value: np.float32) -> str:
    """Return a number in C, with as many digits as distinguish it from its neighbours."""
    return f"{value!s}f"


def _braces(value: np.ndarray, indent: str) -> str:
    """Return an array in C, a line for each innermost row if it fits."""
    inner = indent + "    "
    if value.ndim > 1:
        rows = ",\n".join(inner + _braces(row, inner) for row in value)
        return f"{{\n{rows},\n{indent}}}"
    numbers, lines = [_number(number) for number in value], [""]
    for number in numbers:
        if len(inner + lines[-1] + number) > LINE_LENGTH - 2:
            lines.append("")
        lines[-1] += f"{number}, "
    lines = [line.rstrip() for line in lines]
    if len(lines) == 1:
        return f"{{{lines[0].rstrip(',')}}}"
    return "{\n" + "".join(f"{inner}{line}\n" for line in lines) + f"{indent}}}"
