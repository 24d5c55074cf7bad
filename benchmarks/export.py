"""Time, start-up and memory of the exported nervous system, beside one written by hand, on one core.

    python benchmarks/export.py [--width 80 320]

| program   | what it is                                                                                       |
| --------- | ------------------------------------------------------------------------------------------------ |
| StableHLO | nervous_system.stablehlo in JAX, compiled when it starts                                         |
| ONNX      | nervous_system.onnx in onnxruntime; left out where jax2onnx or onnxruntime is not installed      |
| C         | nervous_system.c, gcc -O2; left out where gcc is not installed                                   |
| by hand   | the same equations with OpenCV (resize, filter2D) and NumPy, as one would write without JAX      |

Each is a process of its own, which sees the same pictures, one call a stereo frame, and all of them run in turns.
Timed is processor time, which on one core equals the wall time of an idle machine. Start-up is the processor time from
the start of the process to the first targets; memory is the largest resident set, with the interpreter if there is one.
"""

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

FRAMES, ROUNDS, STARTS = 60, 30, 3
Step = Callable[[np.ndarray], np.ndarray]  # pictures to u


def start_stablehlo(folder: Path) -> Step:
    """Return a step of the StableHLO file, which keeps its state on JAX's side."""
    import jax
    from jax import export

    card = json.loads((folder / "card.json").read_text())
    program = jax.jit(export.deserialize(bytearray((folder / "nervous_system.stablehlo").read_bytes())).call)
    state = first_state(card)

    def step(pictures: np.ndarray) -> np.ndarray:
        nonlocal state
        output, state = program(pictures, state)
        return np.asarray(output["u"])

    return step


def start_onnx(folder: Path) -> Step:
    """Return a step of the ONNX file."""
    import onnxruntime  # pyright: ignore[reportMissingImports]

    card = json.loads((folder / "card.json").read_text())
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(folder / "nervous_system.onnx"), options)
    names = [output.name for output in session.get_outputs()]
    state = first_state(card)

    def step(pictures: np.ndarray) -> np.ndarray:
        nonlocal state
        output = dict(zip(names, session.run(None, {"pictures": pictures, **state}), strict=True))
        state = {name: output[f"next_{name}"] for name in state}
        return output["u"]

    return step


def first_state(card: dict) -> dict[str, np.ndarray]:
    """Return the state before the first picture."""
    state = card["state"].items()
    return {name: np.broadcast_to(np.array(a["first"], a["type"]), a["shape"]).copy() for name, a in state}


class ByHand:
    """The nervous system in OpenCV and NumPy; a call is a step."""

    def __init__(self, folder: Path):
        import cv2

        cv2.setNumThreads(1)
        self.cv2, self.weights = cv2, dict(np.load(folder / "weights.npz"))
        card = json.loads((folder / "card.json").read_text())
        state = first_state(card)
        self.cells = card["lgmd"]["columns"], card["lgmd"]["rows"]
        self.seen = card["eyes"]["rows_seen"], card["eyes"]["columns_seen"]
        self.column_weights = np.asarray(card["lgmd"]["weights"], np.float32)
        self.last: list[np.ndarray] = []
        self.P = [np.zeros(self.cells[::-1], np.float32) for _ in range(2)]
        self.h, self.c = state["navigator_hidden"], state["navigator_cell"]
        self.u, self.v = state["cpg_activation"], state["cpg_adaptation"]

    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        rows, columns = self.seen
        halves = pictures[0, :rows, :columns], pictures[1, :rows, : -columns - 1 : -1]
        u = np.array([self.see(eye, half) for eye, half in enumerate(halves)], np.float32)
        velocity = self.decide(u)
        for _ in range(6):
            self.move(velocity)
        return u

    def see(self, eye: int, picture: np.ndarray) -> float:
        """Return u of an eye."""
        cv2, w = self.cv2, self.weights
        L = cv2.resize(picture.astype(np.float32), self.cells, interpolation=cv2.INTER_AREA)
        if len(self.last) == eye:
            self.last.append(L)
        I = cv2.filter2D(self.P[eye], cv2.CV_32F, w["kernel"], borderType=cv2.BORDER_CONSTANT)  # noqa: E741
        S = cv2.absdiff(L, self.last[eye]) - w["inhibition"] * np.abs(I)
        mean = (self.column_weights * np.where(w["threshold"] <= S, S, 0)).mean()
        FF = (self.column_weights * np.abs(self.P[eye])).mean()
        self.last[eye], self.P[eye] = L, L - self.last[eye]
        return 0.5 if w["suppression"] < FF else float(sigmoid(mean))

    def decide(self, u: np.ndarray) -> np.ndarray:
        """Return the velocity: the LSTM on the scene and on its mirror image, limited."""
        w = self.weights
        x = (np.stack([u, u[::-1]]) - w["input_mean"]) / w["input_scale"]
        z_i, z_f, z_c, z_o = np.split(x @ w["dense_i"] + self.h @ w["dense_h"] + w["bias"], 4, axis=1)
        self.c = sigmoid(z_f) * self.c + sigmoid(z_i) * np.tanh(z_c)
        self.h = sigmoid(z_o) * np.tanh(self.c)
        views = w["output_mean"] + w["output_scale"] * (self.h @ w["head"] + w["head_bias"])
        left, right = (views[0] + views[1, ::-1]) / 2
        turn = np.clip(right - left, -3, 3)
        mean = np.clip((left + right) / 2, -1 + abs(turn) / 2, 2 - abs(turn) / 2)
        return np.array([mean - turn / 2, mean + turn / 2], np.float32)

    def rates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of activation and adaptation."""
        g = np.maximum(u, 0)
        return (1 - u - 4 * g[:, ::-1] - 7 * v - self.weights["coupling"] @ g) / 1.7, (g - v) / 1.5

    def move(self, velocity: np.ndarray) -> np.ndarray:
        """Advance the CPG by a substep; return the targets."""
        w, h = self.weights, np.float32(6.6941175 / 0.8 / 180 / 4)
        for _ in range(4):
            a = self.rates(self.u, self.v)
            b = self.rates(self.u + h / 2 * a[0], self.v + h / 2 * a[1])
            c = self.rates(self.u + h / 2 * b[0], self.v + h / 2 * b[1])
            d = self.rates(self.u + h * c[0], self.v + h * c[1])
            self.u = self.u + h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            self.v = self.v + h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        rhythm = self.u[:, 0] - self.u[:, 1], self.v[:, 0] - self.v[:, 1]
        inputs = np.column_stack([*rhythm, np.repeat(velocity, 3)])
        units = np.maximum(np.matmul(inputs[:, None], w["w1"])[:, 0] + w["b1"], 0)
        return np.clip(np.matmul(units[:, None], w["w2"])[:, 0] + w["b2"], w["lowest"], w["highest"])


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return the logistic function."""
    return 1 / (1 + np.exp(-x))


PROGRAMS = {"StableHLO": start_stablehlo, "ONNX": start_onnx, "by hand": ByHand}


def work(name: str, folder: Path) -> None:
    """Run one program: print its start-up, then for each line on stdin the time of a frame [ms] and the last u."""
    pictures = np.load(folder / "pictures.npy")
    step = PROGRAMS[name](folder)
    step(pictures[0])
    print(time.process_time(), flush=True)
    for _ in sys.stdin:
        start = time.process_time()
        for picture in pictures:
            u = step(picture)
        print((time.process_time() - start) / FRAMES * 1e3, u[0], flush=True)


def make_pictures(width: int, height: int) -> np.ndarray:
    """Return stereo pictures of a textured panorama that drifts by half a pixel each frame, with noise."""
    import cv2

    rng = np.random.default_rng(0)
    panorama = cv2.GaussianBlur(rng.uniform(0, 255, (height, width + FRAMES)).astype(np.float32), (0, 0), 2.0)
    panorama = 127 + 6 * (panorama - panorama.mean())
    views = [[panorama[:, f // 2 + 12 * eye :][:, :width] for eye in (0, 1)] for f in range(FRAMES)]
    noisy = np.array(views) + rng.normal(0, 1, (FRAMES, 2, height, width))
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def prepare(folder: Path, width: int, formats: list[str]) -> None:
    """Export the pretrained robot, and write pictures and weights beside it."""
    from lgmdjax.deployment import exporter, nervous_system
    from lgmdjax.simulation import assembly

    exporter.export(None, folder, width=width, formats=formats)  # pyright: ignore[reportArgumentType]
    pictures = make_pictures(width, width * 3 // 4)
    np.save(folder / "pictures.npy", pictures)
    (folder / "pictures.bin").write_bytes(pictures.tobytes())
    controller = nervous_system.from_robot(assembly.load_robot()).controller
    policy, networks = controller.policy, controller.shaping
    weights = {name: getattr(policy, name) for name in ("input_mean", "input_scale", "output_mean", "output_scale")}
    weights |= {name: getattr(networks, name) for name in ("w1", "b1", "w2", "b2")}
    weights |= {
        name: getattr(controller.detector, name) for name in ("kernel", "inhibition", "threshold", "suppression")
    }
    cell, head = policy.weights["cell"], policy.weights["head"]
    weights |= {"dense_i": cell["dense_i"]["kernel"], "dense_h": cell["dense_h"]["kernel"]}
    weights |= {"bias": cell["dense_h"]["bias"], "head": head["kernel"], "head_bias": head["bias"]}
    card = exporter.read_card(folder)
    weights |= {"lowest": card["servos"]["lowest"], "highest": card["servos"]["highest"]}
    weights |= {"coupling": controller.cpg.coupling}
    np.savez(folder / "weights.npz", allow_pickle=False, **{n: np.asarray(v, np.float32) for n, v in weights.items()})


def commands(folder: Path, formats: list[str]) -> dict[str, list[str]]:
    """Return the command of each program."""
    own = [sys.executable, __file__, "--folder", str(folder), "--worker"]
    found = {name: [*own, name] for name in PROGRAMS if name != "ONNX" or "onnx" in formats}
    if shutil.which("gcc"):
        program, here = folder / "main", Path(__file__).parent
        sources = [str(here / "export_main.c"), str(folder / "nervous_system.c")]
        subprocess.run(["gcc", "-std=c99", "-O2", f"-I{folder}", *sources, "-lm", "-o", str(program)], check=True)
        found["C"] = [str(program), str(folder / "pictures.bin"), str(FRAMES)]
    return found


def start(command: list[str]) -> tuple[subprocess.Popen[str], float]:
    """Start a program; return it and its start-up [s]."""
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    return process, float(process.stdout.readline())


def ask(process: subprocess.Popen[str]) -> tuple[float, float]:
    """Let a program run over all pictures; return its time of a frame [ms] and the last u."""
    assert process.stdin and process.stdout
    process.stdin.write("\n")
    process.stdin.flush()
    ms, u = process.stdout.readline().split()
    return float(ms), float(u)


def end(process: subprocess.Popen[str]) -> float:
    """End a program; return its largest resident set [MB], NaN where the system does not tell."""
    status = Path(f"/proc/{process.pid}/status")  # ru_maxrss would be that of this process, which started it
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.is_file() else None
    assert process.stdin
    process.stdin.close()
    process.wait()
    return int(found[1]) / 1e3 if found else float("nan")


def compare(width: int) -> None:
    """Print a row for each program at one size of the pictures."""
    installed = all(importlib.util.find_spec(name) for name in ("jax2onnx", "onnxruntime"))
    formats = ["c", "stablehlo", *(["onnx"] if installed else [])]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "robot")
        prepare(folder, width, formats)
        programs = commands(folder, formats)
        startup: dict[str, list[float]] = {name: [] for name in programs}
        for _ in range(STARTS - 1):
            for name, command in programs.items():
                process, seconds = start(command)
                startup[name].append(seconds)
                end(process)
        running = {name: start(command) for name, command in programs.items()}
        ms: dict[str, list[float]] = {name: [] for name in programs}
        for _ in range(ROUNDS):
            u = {}
            for name, (process, _) in running.items():
                milliseconds, u[name] = ask(process)
                ms[name].append(milliseconds)
            assert np.ptp(list(u.values())) < 1e-3, u
        for name, (process, seconds) in running.items():
            fastest, middle = min(ms[name]), statistics.median(ms[name])
            first = min([*startup[name], seconds])
            size, memory = f"{width} x {width * 3 // 4}", end(process)
            print(f"| {size} | {name} | {fastest:.3f} | {middle:.3f} | {first:.3f} | {memory:.1f} |", flush=True)


def main() -> None:
    """Print a table of all programs and sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, nargs="+", default=[80, 320])
    parser.add_argument("--worker", choices=PROGRAMS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if given.worker:
        work(given.worker, given.folder)
        return
    names = ("jax", "numpy", "opencv-python-headless", "onnxruntime", "jax2onnx")
    found = {distribution.metadata["Name"]: distribution.version for distribution in importlib.metadata.distributions()}
    versions = ", ".join(f"{name} {found[name]}" for name in names if name in found)
    print(f"{platform.processor() or platform.machine()}, one core; Python {platform.python_version()}, {versions}")
    print(f"{ROUNDS} rounds of {FRAMES} frames in turns, least of {STARTS} starts\n")
    print("| pictures | program | least [ms] | median [ms] | start-up [s] | memory [MB] |")
    print("| --- | --- | --- | --- | --- | --- |")
    for width in given.width:
        compare(width)


if __name__ == "__main__":
    main()
