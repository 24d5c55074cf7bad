"""Run folders: a stage is done once, carries on after an interruption, and never leaves half a result.

    runs/<name>/run.json                   scale, seed, settings and versions that the run was made with
    runs/<name>/<stage>.partial-<print>/   while the stage works; stays when interrupted, to carry on from
    runs/<name>/<stage>/                   its files, moved here in one step once all of them are written
    runs/<name>/<stage>/done.json          its fingerprint, files, seconds of the last try, versions, device

The fingerprint of a stage covers its settings, the seed, the versions of its format and of lgmdjax, and the
fingerprints of its inputs: a stage whose folder carries the fingerprint that it would get now has nothing to do.
"""

import contextlib
import dataclasses
import hashlib
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
from lgmdjax.errors import InputError
from lgmdjax.runtime import compiled_code, versions
from lgmdjax.runtime.storage import write_json

FORMAT = 1  # of the run folder; a change makes every stage of an older folder run again
SEEDS = 2**32  # in single precision JAX keeps no more of a seed: greater ones would be other ones' twins

# Writes its files into the folder (first argument), which may hold what an interrupted try left there; reads
# the finished folders of its input stages, by their names; gets its own settings and the run's seed.
Work = Callable[[Path, Mapping[str, Path], Any, int], None]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One step of the pipeline; raise `version` when the files it writes change their meaning."""

    name: str
    work: Work
    inputs: tuple[str, ...] = ()
    version: int = 1


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run folder, and the settings of each stage (frozen dataclasses) by the stage's name."""

    folder: Path
    seed: int
    settings: Mapping[str, Any]


def open_run(out: Path, name: str, scale: str, seed: int, settings: Mapping[str, Any]) -> Run:
    """Make the run folder out/name, or take up the one that is there.

    Raises InputError when the folder cannot be written, or was made with another scale, seed or settings.
    """
    if name in ("", ".", "..") or Path(name).name != name:
        raise InputError(f"expected a plain folder name for the run, got {name!r}; use --out for the path")
    if not 0 <= seed < SEEDS:
        raise InputError(f"expected a seed of 0 to {SEEDS - 1}, got {seed}; choose another --seed")
    folder = out / name
    asked = {"format": FORMAT, "scale": scale, "seed": seed, "settings": _plain(settings)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "run.json").exists():
            _check_same(folder, asked)
        else:
            write_json(folder / "run.json", asked | {"versions": versions.installed()})
        (folder / ".lock").touch()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"expected a folder that can be written, got {folder} ({reason}); choose another --out"
        ) from error
    return Run(folder=folder, seed=seed, settings=settings)


def execute(run: Run, stages: Sequence[Stage], target: str) -> Path:
    """Bring a stage and everything it is made from up to date; give the folder of its files.

    Raises InputError when another process is at work in the same run folder.
    """
    stages = [
        dataclasses.replace(stage, inputs=tuple(name for name in stage.inputs if name in run.settings))
        for stage in stages
        if stage.name in run.settings
    ]
    by_name = {stage.name: stage for stage in stages}
    needed = _with_inputs(by_name, target)
    prints: dict[str, str] = {}
    with _alone(run.folder):
        for stage in stages:  # in the order of the pipeline, inputs first
            if stage.name in needed:
                prints[stage.name] = fingerprint(stage, run.settings[stage.name], run.seed, prints)
                _do(run, stage, prints[stage.name])
    return run.folder / target


def fingerprint(stage: Stage, settings: Any, seed: int, inputs: Mapping[str, str]) -> str:
    """Hash all that the files of a stage depend on."""
    facts = {
        "format": FORMAT,
        "stage": stage.name,
        "version": stage.version,
        "lgmdjax": __version__,
        "settings": _plain(settings),
        "seed": seed,
        "inputs": {name: inputs[name] for name in stage.inputs},
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def _do(run: Run, stage: Stage, print_: str) -> None:
    """Run one stage unless it is done."""
    final = run.folder / stage.name
    if _is_done(final, print_):
        print(f"{stage.name}: up to date in {final}", flush=True)
        return
    partial = run.folder / f"{stage.name}.partial-{print_}"
    if not _is_done(partial, print_):  # a kill may have come between the last file and the move
        for stale in set(run.folder.glob(f"{stage.name}.partial-*")) - {partial}:
            shutil.rmtree(stale)
        _announce(stage, final, run.seed, resumed=partial.exists())
        partial.mkdir(exist_ok=True)
        began = time.perf_counter()
        inputs = {name: run.folder / name for name in stage.inputs}
        stage.work(partial, inputs, run.settings[stage.name], run.seed)
        seconds = time.perf_counter() - began
        compiled_code.let_go()
        stamp = {"fingerprint": print_, "seconds": round(seconds, 1), "versions": versions.installed()}
        write_json(partial / "done.json", stamp | {"device": device(), "files": _sizes(partial)})
        print(f"{stage.name}: done in {seconds:.0f} s", flush=True)
    if final.exists():
        shutil.rmtree(final)
    os.replace(partial, final)


def device() -> str:
    """Describe what the arrays live on."""
    devices = jax.devices()
    kind = devices[0].device_kind if devices[0].platform != "cpu" else f"cpu, {os.cpu_count()} cores"
    return kind if len(devices) == 1 else f"{len(devices)} x {kind}"


def _announce(stage: Stage, final: Path, seed: int, *, resumed: bool) -> None:
    found = versions.installed()
    words = ", ".join(f"{name} {found[name]}" for name in ("lgmdjax", "python", "jax", "mujoco"))
    verb = "carries on" if resumed else "starts"
    print(f"{stage.name}: {verb} on {device()}; {words}; seed {seed}; into {final}", flush=True)


def _is_done(folder: Path, print_: str) -> bool:
    try:
        stamp = json.loads((folder / "done.json").read_text())
        return stamp["fingerprint"] == print_ and stamp["files"].items() <= _sizes(folder).items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False  # no stamp that can be read: do it again


def _sizes(folder: Path) -> dict[str, int]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "done.json")
    return {str(path.relative_to(folder)): path.stat().st_size for path in files}


def _with_inputs(stages: Mapping[str, Stage], target: str) -> set[str]:
    return {target}.union(*(_with_inputs(stages, name) for name in stages[target].inputs))


def _plain(settings: Any) -> Any:
    """Turn nested dataclasses into what JSON gives back, so that the two compare equal."""
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        settings = dataclasses.asdict(settings)
    if isinstance(settings, Mapping):
        return {key: _plain(value) for key, value in settings.items()}
    return json.loads(json.dumps(settings))


def _check_same(folder: Path, asked: dict[str, Any]) -> None:
    try:
        made = json.loads((folder / "run.json").read_text())
        differing = _first_difference({key: made[key] for key in asked}, asked)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"expected the settings of a run in {folder / 'run.json'}, got a file that cannot be read; "
            "choose another --name, or delete the folder"
        ) from error
    if differing:
        key, had, wants = differing
        raise InputError(
            f"expected a run folder made with {key} = {wants}, got {folder} made with {had}; "
            "choose another --name or --out, or delete the folder"
        )


def _first_difference(had: Any, wants: Any, key: str = "") -> tuple[str, Any, Any] | None:
    if isinstance(had, dict) and isinstance(wants, dict) and had.keys() == wants.keys():
        inner = (_first_difference(had[k], wants[k], f"{key}.{k}".lstrip(".")) for k in wants)
        return next((found for found in inner if found), None)
    return None if had == wants else (key, had, wants)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the run folder for this process; the system lets go of it however the process ends."""
    try:
        held = FileLock(folder / ".lock").acquire(blocking=False)
    except Timeout as error:
        raise InputError(
            f"expected {folder} to be free, got a run at work in it; wait, or choose another --name"
        ) from error
    with held:
        yield
