"""`lgmdjax bench closed-loop`: every looming detector as the eyes of the same robot.

Writes a run folder, closed-loop-<scale>, with a folder for each stage (`lgmdjax.bench.closed_loop`), and there

| file                    | content                                                                |
| ----------------------- | ---------------------------------------------------------------------- |
| scores.md, .tex, .csv   | the table for a page, for a paper, and every number with its interval  |
| scores.json             | the same as JSON, with settings, seed and versions                     |
| scores.png              | collisions, coverage and hard turning of every detector                |
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from lgmdjax.bench import closed_loop, tables, worlds
from lgmdjax.bench.settings import CAMERA_FAULTS, CLOSED_LOOP_SCALES, ClosedLoopSettings
from lgmdjax.cli.flags import BenchFlags
from lgmdjax.errors import InputError
from lgmdjax.reporting.figures import detector_walks, style
from lgmdjax.runtime import partial_files, run_folders, storage, versions
from lgmdjax.runtime.storage import JsonObject
from lgmdjax.simulation import assembly

CAPTION = "Looming detectors that steer the same robot, with navigators trained in the same way."


def run_closed_loop(flags: BenchFlags) -> Iterator[str]:
    """Run the comparison, or resume it; yield a line about each detector, then the names of the files."""
    if flags.paths:
        raise InputError(f"expected no paths after bench {flags.on}, got {flags.paths[0]}; only bench clips has some")
    names, size = closed_loop.choose(flags.detector), CLOSED_LOOP_SCALES[flags.scale]
    robot = assembly.load_robot(flags.run / "fit-gait", flags.run / "train") if flags.run else assembly.load_robot()
    stages, settings = closed_loop.plan(robot, names, size)
    name, remedy = f"closed-loop-{flags.scale}", "choose another --out"
    run = run_folders.open_run(flags.out, name, flags.scale, flags.seed, settings, remedy=remedy)
    rows = storage.read_json(run_folders.execute(run, stages, closed_loop.SCORES) / "scores.json")
    for row in rows:
        rooms = row[worlds.ROOMS]
        yield (
            f"{row['detector']}: collisions per 100 m {tables.estimate(rooms['per_100_m'], 1)}, "
            f"coverage {tables.estimate(rooms['progress']['coverage'], 1)} / min"
        )
    for file in write(run.folder, rows, size, flags.seed):
        yield str(file)


def write(folder: Path, rows: Sequence[JsonObject], size: ClosedLoopSettings, seed: int) -> list[Path]:
    """Write tables and figure into a folder; return the files."""
    facts = {"settings": asdict(size), "seed": seed, "versions": versions.installed(), "rows": rows}
    table = tables.closed_loop(rows)
    texts = {"scores.md": table.markdown(), "scores.tex": table.latex(CAPTION), "scores.csv": tables.to_csv(rows)}
    figure = detector_walks.plot(rows, (worlds.ROOMS, *CAMERA_FAULTS))
    with partial_files.replacing_all(folder) as partial:
        storage.write_json(partial / "scores.json", facts)
        (partial / "scores.png").write_bytes(style.to_png(figure))
        for name, text in texts.items():
            (partial / name).write_text(text, encoding="utf-8")
    return [folder / name for name in (*texts, "scores.json", "scores.png")]
