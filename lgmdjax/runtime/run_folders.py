"""Run folders: a stage runs once, resumes after an interruption, and never leaves half a result.

| path                                       | content                                                          |
| ------------------------------------------ | ---------------------------------------------------------------- |
| runs/<name>/run.json                       | format, scale, seed, settings and versions of the run            |
| runs/<name>/<stage>.partial-<fingerprint>/ | files of a stage that is running, or was interrupted             |
| runs/<name>/<stage>/                       | files of a finished stage, moved here in one step                |
| runs/<name>/<stage>/done.json              | fingerprint, checksums of the files, seconds, versions, device   |
| runs/<name>/.lock                          | locked by the process that runs stages                           |

A stage's fingerprint covers its settings, the seed, the versions of its format and of lgmdjax, and the fingerprints of
its inputs. A stage is up to date if its folder has the fingerprint that the stage would get now, and its files have the
checksums that they had when it finished. run.json and done.json have a checksum of their own.

Of several processes (`lgmdjax.runtime.distributed`) the first one holds the lock, decides which stages run, and writes
all files but recorded walks. The others run the stages that are `shared` with it, and wait for it meanwhile.

Folders of format 1 (version 0.1.0) have other names for some settings. Their robots can be loaded; their stages cannot
be resumed.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from filelock import FileLock, Timeout

from lgmdjax import __version__
from lgmdjax.errors import InputError, one_line
from lgmdjax.runtime import (
    checksums,
    compiled_code,
    distributed,
    partial_files,
    schema,
    seeds,
    storage,
    versions,
)
from lgmdjax.runtime.storage import JsonObject

FORMAT = 2  # of the run folder; no stage is resumed in a folder of another format
ABSENT = "none"  # in messages, in place of a setting that only one of two runs has

StageFunction = Callable[[Path, Mapping[str, Path], Any, int], None]
"""Function of a stage: `run(folder, inputs, settings, seed)`.

It writes its files into `folder`, which may hold those of an interrupted run, and reads the finished folders of its
input stages, by name.
"""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A step of the pipeline."""

    name: str
    run: StageFunction
    inputs: tuple[str, ...] = ()  # names of stages
    version: int = 1  # raise it when the files of the stage change their meaning
    shared: bool = False  # whether all processes of a run work on it, or the first one alone


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder, and the settings (frozen dataclasses) of its stages by name."""

    folder: Path
    seed: int
    settings: Mapping[str, object]
    remedy: str = "choose another --name"  # in messages: how to get another folder


def open_run(
    out: Path, name: str, scale: str, seed: int, settings: Mapping[str, object], *, remedy: str = Run.remedy
) -> Run:
    """Open the run folder out/name, or make it.

    Raises `InputError` for a folder that cannot be written, that another process uses, or that was made with another
    scale, seed or settings.
    """
    if name in ("", ".", "..") or Path(name).name != name or not name.isprintable():
        raise InputError(f"expected a plain folder name for the run, got {name!r}; use --out for the path")
    seeds.check(seed)
    run = Run(folder=out / name, seed=seed, settings=settings, remedy=remedy)
    partial_files.require_utf8(run.folder)
    requested = {"format": FORMAT, "scale": scale, "seed": seed, "settings": _to_json(settings)}
    try:
        partial_files.make_folder(run.folder)
        if distributed.is_first() and not (run.folder / "run.json").exists():
            with _locked(run):
                facts = checksums.add_checksum(requested | {"versions": versions.installed()})
                storage.write_json(run.folder / "run.json", facts)
        distributed.wait(f"{run.folder}: start")
        distributed.await_files([run.folder / "run.json"])
        _check_same(run, requested)
        (run.folder / ".lock").touch()
    except OSError as error:
        raise partial_files.not_writable(run.folder, error) from error
    return run


def execute(run: Run, stages: Sequence[Stage], target: str) -> Path:
    """Run the stages that `target` needs and that are not up to date, then `target`; return its folder.

    Stages without settings in this run are left out, also as inputs of others. Raises `InputError` if another process
    is running stages in the same folder.

    Args:
        run: from `open_run`.
        stages: in the order of the pipeline, inputs first.
        target: name of a stage.
    """
    stages = [
        dataclasses.replace(stage, inputs=tuple(name for name in stage.inputs if name in run.settings))
        for stage in stages
        if stage.name in run.settings
    ]
    required = _required_stages({stage.name: stage for stage in stages}, target)
    fingerprints: dict[str, str] = {}
    with _locked(run):
        for abandoned in run.folder.glob(f"*{checksums.PARTIAL}") if distributed.is_first() else ():
            abandoned.unlink(missing_ok=True)
        for stage in stages:
            if stage.name in required:
                settings = run.settings[stage.name]
                fingerprints[stage.name] = fingerprint(stage, settings, run.seed, fingerprints)
                update = _update if distributed.is_first() else _join
                update(run, stage, fingerprints[stage.name])
    return run.folder / target


def fingerprint(stage: Stage, settings: object, seed: int, inputs: Mapping[str, str]) -> str:
    """Return a hash of everything that the files of a stage depend on; `inputs` has the stages' fingerprints."""
    facts = {
        "format": FORMAT,
        "stage": stage.name,
        "version": stage.version,
        "lgmdjax": __version__,
        "settings": _to_json(settings),
        "seed": seed,
        "inputs": {name: inputs[name] for name in stage.inputs},
    }
    return checksums.digest(json.dumps(facts, sort_keys=True).encode())[:16]


def describe_devices() -> str:
    """Name the devices that JAX computes on."""
    devices = jax.local_devices()
    kind = devices[0].device_kind if devices[0].platform != "cpu" else f"cpu, {os.cpu_count()} cores"
    described = kind if len(devices) == 1 else f"{len(devices)} x {kind}"
    return described if distributed.count() == 1 else f"{distributed.count()} processes with {described}"


def _update(run: Run, stage: Stage, stage_fingerprint: str) -> None:
    """Run one stage unless it is up to date."""
    final = run.folder / stage.name
    fault = _find_fault(final, stage_fingerprint)
    if fault is None:
        print(f"{stage.name}: up to date in {final}", flush=True)
        _tell_start(stage, runs=False)
        distributed.wait(f"{stage.name}: end")
        return
    if fault:
        print(f"{stage.name}: done again, because {fault}", flush=True)
    partial = _partial(run, stage, stage_fingerprint)
    _adopt_stamp(partial)
    if _find_fault(partial, stage_fingerprint) is not None:  # None if the process was killed before the move below
        (partial / checksums.STAMP).unlink(missing_ok=True)
        for outdated in set(run.folder.glob(f"{stage.name}{checksums.PARTIAL}-*")) - {partial}:
            shutil.rmtree(outdated)
        _print_start(stage, final, run.seed, resumed=partial.exists())
        seconds = _run_in(partial, run, stage, stage_fingerprint)
        print(f"{stage.name}: done in {seconds:.0f} s", flush=True)
    else:
        _tell_start(stage, runs=False)
    if final.exists():
        shutil.rmtree(final)
    os.replace(partial, final)
    partial_files.sync(run.folder)
    distributed.wait(f"{stage.name}: end")


def _join(run: Run, stage: Stage, stage_fingerprint: str) -> None:
    """Do this process's part of a stage that the first process runs; wait for it otherwise."""
    if _tell_start(stage) and stage.shared:
        partial = _partial(run, stage, stage_fingerprint)
        inputs = _inputs(run, stage)
        distributed.await_files([partial, *(folder / checksums.STAMP for folder in inputs.values())])
        stage.run(partial, inputs, run.settings[stage.name], run.seed)
        distributed.wait(f"{stage.name}: files")
    distributed.wait(f"{stage.name}: end")


def _tell_start(stage: Stage, *, runs: bool = True) -> bool:
    """Return whether a stage runs, which the first process tells the others."""
    return distributed.share(f"{stage.name}: start", lambda: runs)


def _partial(run: Run, stage: Stage, stage_fingerprint: str) -> Path:
    return run.folder / f"{stage.name}{checksums.PARTIAL}-{stage_fingerprint}"


def _inputs(run: Run, stage: Stage) -> dict[str, Path]:
    """Return the folders of a stage's inputs by name."""
    return {name: run.folder / name for name in stage.inputs}


def _adopt_stamp(folder: Path) -> None:
    """Rename a complete done.json whose process was killed before it could rename it."""
    for written in folder.glob(f"{checksums.STAMP}.*{checksums.PARTIAL}"):
        with contextlib.suppress(OSError, ValueError, RecursionError):
            if checksums.has_valid_checksum(json.loads(written.read_bytes())):
                os.replace(written, folder / checksums.STAMP)


def _run_in(folder: Path, run: Run, stage: Stage, stage_fingerprint: str) -> float:
    """Run a stage in a folder, which may hold files of an interrupted run; return the seconds that it took."""
    folder.mkdir(exist_ok=True)
    partial_files.remove_partial_files(folder)
    start = time.perf_counter()
    _tell_start(stage)
    with contextlib.nullcontext() if stage.shared else distributed.alone():
        stage.run(folder, _inputs(run, stage), run.settings[stage.name], run.seed)
    if stage.shared:
        distributed.wait(f"{stage.name}: files")
    seconds = time.perf_counter() - start
    compiled_code.clear_caches_if_near_limit()
    facts = {"fingerprint": stage_fingerprint, "seconds": round(seconds, 1), "versions": versions.installed()}
    storage.write_stamp(folder, facts | {"device": describe_devices()})
    return seconds


def _print_start(stage: Stage, final: Path, seed: int, *, resumed: bool) -> None:
    installed = versions.installed()
    packages = ", ".join(f"{name} {installed[name]}" for name in ("lgmdjax", "python", "jax", "mujoco"))
    verb = "resumes" if resumed else "starts"
    print(f"{stage.name}: {verb} on {describe_devices()}; {packages}; seed {seed}; into {final}", flush=True)


def _find_fault(folder: Path, stage_fingerprint: str) -> str | None:
    """Return None if a folder has a finished stage of this fingerprint, else what is wrong; "" without a folder."""
    if not (folder / checksums.STAMP).exists():
        return f"{folder} has no {checksums.STAMP}" if folder.exists() else ""
    try:
        stamp = checksums.read_stamp(folder)
        if stamp.facts.get("fingerprint") != stage_fingerprint:
            return "something that it depends on has changed"
        files = stamp.facts["files"] if stamp.files is None else stamp.files
        found = _file_sizes(folder) if stamp.files is None else checksums.list_files(folder)
    except (OSError, KeyError, checksums.ChecksumError) as error:
        return one_line(error)
    changed = [name for name, value in files.items() if found.get(name) != value]
    return f"{folder / changed[0]} is missing or has changed" if changed else None


def _file_sizes(folder: Path) -> dict[str, int]:
    """Return the sizes of all files, which done.json of older versions lists in place of checksums."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def _required_stages(stages: Mapping[str, Stage], target: str) -> set[str]:
    """Return the names of `target` and of all stages that it depends on."""
    return {target}.union(*(_required_stages(stages, name) for name in stages[target].inputs))


def _to_json(settings: object) -> object:
    """Convert nested dataclasses to the values that they have when read back from JSON."""
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        settings = dataclasses.asdict(settings)
    if isinstance(settings, Mapping):
        return {key: _to_json(value) for key, value in settings.items()}
    return json.loads(json.dumps(settings))


SEED = schema.Integer(0, seeds.LIMIT - 1)
RUN_FACTS = schema.Object({"format": schema.Integer(1, 1000), "settings": schema.Object()}, {"seed": SEED})
"""Schema of run.json in every format."""
PRESENT_FACTS = schema.Object({"scale": schema.Text(), "seed": SEED, "versions": schema.Object()})
"""Schema of its further fields in the present format."""


def read_facts(folder: Path) -> JsonObject:
    """Read the run.json of a run folder; raise `InputError` for one that is missing, damaged or not as expected."""
    path = folder / "run.json"
    facts = storage.read_json(path)
    schema.check(RUN_FACTS, facts, str(path), "delete the folder, or choose another")
    if facts["format"] == FORMAT:
        schema.check(PRESENT_FACTS, facts, str(path), "delete the folder, or choose another")
    return facts


def _check_same(run: Run, requested: JsonObject) -> None:
    """Raise `InputError` unless a run folder was made in this format with the requested scale, seed and settings."""
    recorded = read_facts(run.folder)
    if recorded["format"] != FORMAT:
        maker = "a newer" if recorded["format"] > FORMAT else "an older"
        raise InputError(
            f"expected a run folder of format {FORMAT}, got {run.folder} of format {recorded['format']}, made by "
            f"{maker} lgmdjax; its robot can still be used with --run; {run.remedy} to run the stages"
        )
    difference = _first_difference({key: recorded[key] for key in requested}, requested)
    if difference:
        key, found, expected = difference
        raise InputError(
            f"expected a run folder made with {key} = {expected}, got {run.folder} made with {found}; "
            f"{run.remedy}, or delete the folder"
        )


def _first_difference(found: object, expected: object, key: str = "") -> tuple[str, object, object] | None:
    """Return the path and the two values of the first setting that differs; None if none does."""
    if isinstance(found, dict) and isinstance(expected, dict):
        names = dict.fromkeys((*expected, *found))
        parts = [(name, found.get(name, ABSENT), expected.get(name, ABSENT)) for name in names]
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        parts = [(index, *pair) for index, pair in enumerate(zip(found, expected, strict=True))]
    else:
        return None if found == expected else (key, found, expected)
    differences = (_first_difference(one, other, f"{key}.{name}".lstrip(".")) for name, one, other in parts)
    return next((difference for difference in differences if difference), None)


@contextlib.contextmanager
def _locked(run: Run) -> Iterator[None]:
    """Hold the lock of a run folder; the operating system releases it however the process ends.

    Of several processes of a run, only the first holds it.
    """
    if not distributed.is_first():
        yield
        return
    try:
        lock = FileLock(run.folder / ".lock").acquire(blocking=False)
    except Timeout as error:
        raise InputError(
            f"expected {run.folder} to be unused, got one where another process runs stages; wait, or {run.remedy}"
        ) from error
    with lock:
        yield
