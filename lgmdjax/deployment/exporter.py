"""Export a trained robot's nervous system: one folder with a program in each format, and a card.

| file                     | contents                                                     | module           |
| ------------------------ | ------------------------------------------------------------ | ---------------- |
| nervous_system.onnx      | graph for onnxruntime and other runtimes                     | `onnx_graph`     |
| nervous_system.stablehlo | program for XLA on CPU and CUDA                              | `stablehlo`      |
| nervous_system.c, .h     | C99 for micro-controllers                                    | `c_source`       |
| card.json                | eyes, units, orders, limits, training, scores, hashes        | `card`           |
"""

from collections.abc import Sequence
from pathlib import Path

import jax

from lgmdjax.control import navigator
from lgmdjax.deployment import c_source, card, nervous_system, onnx_graph, stablehlo
from lgmdjax.deployment.formats import FORMATS, PRETRAINED, Format
from lgmdjax.errors import InputError
from lgmdjax.paths import PRETRAINED_DIR
from lgmdjax.runtime import partial_files, schema, storage
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly, closed_loop

CONTROLLER = "controller.safetensors"


def export(run: Path | None, out: Path, *, width: int | None = None, formats: Sequence[Format] = FORMATS) -> JsonObject:
    """Write the nervous system of a robot into a new folder, whole or not at all; return its card.

    The export is in single precision, whatever the present precision of JAX.

    Args:
        run: run folder of the robot; the pretrained robot if None.
        out: the folder to write; it must be empty or missing.
        width: of the pictures [px], by default as in training; the LGMD's cells cover the same angle at any width.
        formats: which programs to write.

    Raises InputError for a folder with files, a run without a controller, an impossible width, a missing library.

    ```python
    card = lj.deployment.exporter.export(None, Path("robot"), formats=["c"])
    print(card["servos"]["legs"])
    ```
    """
    if "onnx" in formats:
        onnx_graph.check_installed()
    partial_files.require_empty(out)
    _, train_folder = _stage_folders(run)
    with jax.enable_x64(False):
        robot = _load_robot(run, width)
        params = nervous_system.from_robot(robot)
        name = PRETRAINED if run is None else run.resolve().name
        with partial_files.new_folder(out) as folder:
            _write_programs(folder, params, f"robot {name} ({assembly.fingerprint(robot)})", formats)
            facts = {
                **card.describe(params),
                "robot": {"name": name, "fingerprint": assembly.fingerprint(robot)},
                "training": navigator.load(train_folder / CONTROLLER)[1],
                "scores": None if run is None else _read_scores(run),
                "files": card.describe_files(folder),
            }
            storage.write_json(folder / card.FILE, facts)
    return facts


def load(run: Path | None, width: int | None = None) -> nervous_system.Params:
    """Return the nervous system of a robot, in single precision; arguments and errors as in `export`."""
    with jax.enable_x64(False):
        return nervous_system.from_robot(_load_robot(run, width))


def read_card(folder: Path) -> JsonObject:
    """Return the card of an exported folder."""
    return storage.read_json(folder / card.FILE)


def _load_robot(run: Path | None, width: int | None) -> closed_loop.Params:
    robot = assembly.load_robot(*_stage_folders(run))
    return robot if width is None else assembly.with_resolution(robot, assembly.scale_resolution(robot, width))


def _stage_folders(run: Path | None) -> tuple[Path, Path]:
    """Return the folders of gait and controller; raise `InputError` for a run without them."""
    if run is None:
        return PRETRAINED_DIR, PRETRAINED_DIR
    if not run.is_dir():
        raise InputError(
            f"expected a run folder or the word {PRETRAINED}, got {run}, which is not a folder; name another"
        )
    if not (run / "train" / CONTROLLER).is_file():
        raise InputError(
            f"expected a run with a controller, got {run} without train/{CONTROLLER}; "
            "finish its stage with `lgmdjax train`, or name another run"
        )
    return run / "fit-gait", run / "train"


def _write_programs(folder: Path, params: nervous_system.Params, robot: str, formats: Sequence[Format]) -> None:
    if "c" in formats:
        for name, text in c_source.generate(params, robot).items():
            (folder / name).write_text(text, encoding="ascii")
    if "stablehlo" in formats:
        stablehlo.write(folder, params)
    if "onnx" in formats:
        onnx_graph.write(folder, params)


def _read_scores(run: Path) -> JsonObject | None:
    """Return what stage evaluate measured of the learned policy, by trial; None if it did not run.

    Trials whose plan leaves the learned policy out are left out too.
    """
    path = run / "evaluate" / "evaluation.json"
    if not path.is_file():
        return None
    trials, remedy = storage.read_json(path), "run `lgmdjax evaluate` again"
    schema.check(schema.Object(), trials, str(path), remedy)
    schema.check(schema.Object(dict.fromkeys(trials, schema.Object())), trials, str(path), remedy)
    return {trial: by_policy["learned"] for trial, by_policy in trials.items() if "learned" in by_policy}
