"""Every exported program does what JAX does, over 300 frames fed back; and JAX does what the paper's equations say."""

import importlib.util
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from reference import cpg as reference_cpg
from reference import lgmd as reference_lgmd
from reference import navigator as reference_navigator
from reference import walking
from stereo_clip import record

from lgmdjax.control import navigator
from lgmdjax.deployment import exporter, nervous_system, onnx_graph
from lgmdjax.detectors import lgmd
from lgmdjax.locomotion import cpg, shaping
from lgmdjax.simulation import assembly

FRAMES = 300
TOLERANCE = 1e-4
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
DRIVER = Path(__file__).parent / "driver.c"

Series = dict[str, np.ndarray]

needs_gcc = pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed: C is not compiled")


@pytest.fixture(scope="module")
def params():
    with jax.enable_x64(False):
        return nervous_system.from_robot(assembly.load_robot())


@pytest.fixture(scope="module")
def pictures(params):
    _, height, width = nervous_system.picture_shape(params)
    return record(FRAMES, width, height, seed=0)


@pytest.fixture(scope="module")
def starts(params):
    """The first state, and one with another memory and another phase of the rhythm."""
    with jax.enable_x64(False):
        first = nervous_system.init(params)
        policy = params.controller.policy
        shape, key = first.navigator.hidden.shape, jax.random.key(1)
        memory = navigator.State(
            hidden=jax.random.uniform(key, shape, minval=-1), cell=jax.random.normal(key, shape), velocity=jnp.zeros(2)
        )
        assert policy.variant == "lstm"
        return first, replace(first, navigator=memory, cpg=cpg.init(params.controller.cpg, key))


@pytest.fixture(scope="module")
def expected(params, pictures, starts) -> list[Series]:
    """What JAX commands from either start."""

    @jax.jit
    def run(state):
        return jax.lax.scan(lambda state, frame: nervous_system.step(params, state, frame), state, pictures)[1]

    with jax.enable_x64(False):
        return [jax.tree.map(np.asarray, vars(run(state))) for state in starts]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("export") / "robot"
    exporter.export(None, out, formats=["c", "stablehlo"])
    return out


def compile_c(folder: Path, *flags: str) -> Path:
    program = folder.parent / "-".join(["driver", *(flag.strip("-").replace("=", "-") for flag in flags)])
    sources = [str(folder / "nervous_system.c"), str(DRIVER)]
    command = ["gcc", *STRICT, *flags, f"-I{folder}", *sources, "-lm", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


def run_c(command: list[str], start: nervous_system.State, pictures: np.ndarray) -> tuple[Series, str]:
    """Run the driver; return what it commands, and what it says on stderr."""
    memory = [np.asarray(leaf, np.float32).tobytes() for leaf in jax.tree.leaves((start.navigator, start.cpg))]
    done = subprocess.run(command, input=b"".join(memory) + pictures.tobytes(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    rows = np.frombuffer(done.stdout, np.float32).reshape(len(pictures), -1)
    targets = rows[:, 4:].reshape(len(pictures), -1, 6, 3)
    return {"u": rows[:, :2], "velocity": rows[:, 2:4], "targets": targets}, done.stderr.decode()


def assert_equal(found: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray]) -> None:
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=0, atol=TOLERANCE, err_msg=name)


def test_the_pictures_exercise_both_detectors_and_no_cell_is_so_near_its_threshold_that_rounding_decides(
    params, pictures, expected
):
    u = expected[0]["u"]
    assert np.all(np.ptp(u[1:], axis=0) > 0.1) and np.any(u[2:] == lgmd.U_AT_REST) and np.mean(u > 0.51) > 0.5
    assert np.all(np.ptp(expected[0]["velocity"], axis=0) > 0.5)
    detector = params.controller.detector
    eyes = pictures[:, 0, :30, :40], pictures[:, 1, :30, :39:-1]
    cells = np.stack([[lgmd_cells(detector, eye)] for eye in eyes])
    P = np.diff(cells.reshape(2, FRAMES, *cells.shape[-2:]).astype(float), axis=1)
    I = np.stack([[np.abs(correlate(difference)) for difference in eye] for eye in P[:, :-1]])  # noqa: E741
    S = np.abs(P[:, 1:]) - I * float(detector.inhibition)
    assert np.min(np.abs(S - float(detector.threshold))) > 1e-6


def lgmd_cells(detector: lgmd.Params, frames: np.ndarray) -> np.ndarray:
    with jax.enable_x64(False):
        return np.asarray(jax.jit(jax.vmap(lambda frame: lgmd.pool(detector, frame)))(frames))


def correlate(difference: np.ndarray) -> np.ndarray:
    padded = np.pad(difference, 2)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    return np.einsum("yxij,ij->yx", windows, reference_lgmd.W_I)


def test_jax_equals_the_papers_equations(params, pictures, expected):
    """A second of it in double precision, from the transcriptions of LGMD, LSTM and Matsuoka's network."""
    frames, detector, policy = 30, params.controller.detector, params.controller.policy
    halves = pictures[:frames, 0, :30, :40], pictures[:frames, 1, :30, :39:-1]  # above the horizon, outermost first
    cells = [lgmd_cells(detector, half).astype(float) for half in halves]
    thresholds = float(detector.threshold), float(detector.suppression), float(detector.inhibition)
    rows = [reference_lgmd.lgmd(eye, *thresholds, falloff=detector.falloff) for eye in cells]
    u = np.array([[0.5] + [row["u"] for row in eye] for eye in rows]).T
    np.testing.assert_allclose(expected[0]["u"][:frames], u, atol=TOLERANCE)

    velocity = (decide(policy, u) + decide(policy, u[:, ::-1])[:, ::-1]) / 2
    turn = np.clip(velocity[:, 1] - velocity[:, 0], -3, 3)
    mean = np.clip(velocity.mean(axis=1), -1 + np.abs(turn) / 2, 2 - np.abs(turn) / 2)
    velocity = np.stack([mean - turn / 2, mean + turn / 2], axis=1)
    np.testing.assert_allclose(expected[0]["velocity"][:frames], velocity, atol=5e-3)  # u is in the input 14-fold

    even = cpg.LIMIT_CYCLE_ACTIVATION, cpg.LIMIT_CYCLE_ADAPTATION
    start = [values[::-1] if leg % 2 else values for values in even for leg in range(6)]
    start = np.array(start).reshape(2, 6, 2).transpose(0, 2, 1).reshape(4, 6)
    times = np.arange(1, 6 * frames + 1) / 180 * cpg.NATURAL_PERIOD / cpg.CYCLE_TIME
    ue, uf, ve, vf = np.moveaxis(reference_cpg.solve(start, times), 1, 0)
    targets = shape(params, np.stack([ue - uf, ve - vf], axis=-1), np.repeat(velocity, 6, axis=0))
    np.testing.assert_allclose(expected[0]["targets"][:frames].reshape(-1, 6, 3), targets, atol=1e-3)


def decide(policy: navigator.Params, u: np.ndarray) -> np.ndarray:
    """Return the output of the LSTM for one view, from Keras's formulas."""
    cell, head = policy.weights["cell"], policy.weights["head"]
    x = (u - np.asarray(policy.input_mean)) / np.asarray(policy.input_scale)
    arrays = cell["dense_i"]["kernel"], cell["dense_h"]["kernel"], cell["dense_h"]["bias"], head["kernel"], head["bias"]
    output = reference_navigator.lstm(x, *(np.asarray(array, float) for array in arrays))
    return np.asarray(policy.output_mean) + np.asarray(policy.output_scale) * output


def shape(params: nervous_system.Params, rhythm: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the targets (steps, 6, 3) of the shaping networks, one leg at a time."""
    networks = params.controller.shaping
    targets = np.empty((len(rhythm), 6, 3))
    for leg in range(6):
        w1, b1, w2, b2 = (np.asarray(getattr(networks, name)[leg], float) for name in shaping.SHAPES)
        inputs = np.column_stack([rhythm[:, leg], velocity[:, leg // 3]])
        targets[:, leg] = np.maximum(inputs @ w1 + b1, 0) @ w2 + b2
    return np.clip(targets, *np.deg2rad([[-75, -100, -102], [75, 100, 67]]))


@needs_gcc
@pytest.mark.parametrize("start", [0, 1])
def test_c_equals_jax(folder, pictures, starts, expected, start):
    found, size = run_c([str(compile_c(folder, "-O2"))], starts[start], pictures)
    assert_equal(found, expected[start])
    card = exporter.read_card(folder)
    print(f"static memory: {size.strip()} bytes of state, {card['memory']['constants']} bytes of constants")
    assert int(size) == card["memory"]["state"]


@needs_gcc
def test_c_is_clean_under_the_sanitizer_of_undefined_behaviour(folder, pictures, starts, expected):
    program = compile_c(folder, "-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    found, _ = run_c([str(program)], starts[0], pictures)
    assert_equal(found, expected[0])


@needs_gcc
@pytest.mark.skipif(not shutil.which("valgrind"), reason="valgrind is not installed: no check of C's memory accesses")
def test_c_is_clean_under_valgrind(folder, pictures, starts):
    command = ["valgrind", "--quiet", "--error-exitcode=9", "--leak-check=full", str(compile_c(folder, "-O1"))]
    _, said = run_c(command, starts[0], pictures[:5])
    assert len(said.splitlines()) == 1, said  # the size of the state alone


@needs_gcc
def test_the_c_program_walks_in_mujoco(folder, starts):
    """Before a still picture: straight ahead, at about the nominal 0.05 m/s times the mean command."""
    still = np.full((180, 2, 60, 80), 120, np.uint8)
    found, _ = run_c([str(compile_c(folder, "-O2"))], starts[0], still)
    walk = walking.simulate(found["targets"].reshape(-1, 6, 3))
    assert walk.speed == pytest.approx(0.05 * found["velocity"][90:].mean(), rel=0.3)
    assert abs(walk.yaw_rate) < 0.03 and np.abs(walk.roll).max() < 10


@needs_gcc
def test_the_program_of_the_how_to_compiles(folder, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
    (tmp_path / "main.c").write_text(page.partition("```c\n")[2].partition("```")[0])
    command = ["gcc", *STRICT, f"-I{folder}", "-c", str(tmp_path / "main.c"), "-o", str(tmp_path / "main.o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("start", [0, 1])
def test_stablehlo_equals_jax(folder, pictures, starts, expected, start):
    exported = export.deserialize(bytearray((folder / "nervous_system.stablehlo").read_bytes()))
    assert exported.platforms == ("cpu", "cuda")

    def step(state, frame):
        output, state = exported.call(frame, state)
        return state, output

    with jax.enable_x64(False):
        _, found = jax.jit(partial(jax.lax.scan, step))(nervous_system.to_arrays(starts[start]), pictures)
    assert_equal(jax.tree.map(np.asarray, found), expected[start])


@pytest.mark.skipif(not onnx_graph.HAS_JAX2ONNX, reason="jax2onnx is not installed: no ONNX is written")
@pytest.mark.skipif(importlib.util.find_spec("onnxruntime") is None, reason="no onnxruntime: no ONNX is run")
def test_onnx_equals_jax(tmp_path, pictures, starts, expected):
    import onnxruntime  # pyright: ignore[reportMissingImports]

    exporter.export(None, tmp_path / "robot", formats=["onnx"])
    session = onnxruntime.InferenceSession(str(tmp_path / "robot" / "nervous_system.onnx"))
    names = [output.name for output in session.get_outputs()]
    for start, outputs in zip(starts, expected, strict=True):
        state = {name: np.asarray(value) for name, value in nervous_system.to_arrays(start).items()}
        rows = []
        for picture in pictures:
            rows.append(dict(zip(names, session.run(None, {"pictures": picture, **state}), strict=True)))
            state = {name: rows[-1][f"next_{name}"] for name in state}
        assert_equal({name: np.stack([row[name] for row in rows]) for name in outputs}, outputs)
