"""Stage collect in several processes of this machine, started as a user does; and a fit that they compute together."""

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
FIT = ROOT / "tests" / "learning" / "fit_in_processes.py"
EPISODES = 5
SETTINGS = (
    "--scale", "smoke", "--name", "run", "--collect.episodes", str(EPISODES), "--collect.seconds", "4",
    "--collect.calibration-seconds", "6", "--fit-gait.steps", "60", "--fit-gait.seconds", "5",
)  # fmt: skip
COLLECT = (sys.executable, "-m", "lgmdjax", "collect", *SETTINGS)

pytestmark = pytest.mark.extended


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def start(out: Path, processes: int) -> list[subprocess.Popen[str]]:
    """Start the processes of one run."""
    address, started = free_address(), []
    for process in range(processes):
        place = ("--coordinator", address, "--processes", str(processes), "--process", str(process))
        started.append(open_process([*COLLECT, "--out", str(out), *place]))
    return started


def open_process(call: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(call, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(started: list[subprocess.Popen[str]]) -> list[str]:
    """Wait until processes have ended well; return the standard output of each."""
    outputs = [process.communicate(timeout=900) for process in started]
    for process, (_, errors) in zip(started, outputs, strict=True):
        assert process.returncode == 0, errors[-3000:]
    return [output for output, _ in outputs]


def without_gloo(output: str) -> str:
    """Return what a process printed, without the lines of the library that connects CPUs."""
    return "".join(line for line in output.splitlines(keepends=True) if not line.startswith("[Gloo]"))


def chunks(out: Path) -> dict[str, bytes]:
    folder = out / "run" / "collect" / "episodes"
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    """The run of a single process."""
    out = tmp_path_factory.mktemp("single")
    done = subprocess.run([*COLLECT, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return out


@pytest.fixture
def unrecorded(single, tmp_path) -> Path:
    """A run in which the gait is fitted and the detector calibrated, and nothing recorded."""
    shutil.copytree(single, tmp_path / "out")
    collect = tmp_path / "out" / "run" / "collect"
    fingerprint = json.loads((collect / "done.json").read_text())["fingerprint"]
    (collect / "done.json").unlink()
    shutil.rmtree(collect / "episodes")
    collect.rename(collect.with_name(f"collect.partial-{fingerprint}"))
    return tmp_path / "out"


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_any_number_of_processes_records_the_same_bytes(single, unrecorded, processes):
    first, *others = (without_gloo(output) for output in finish(start(unrecorded, processes)))
    assert "collect: done in" in first and others == [""] * (processes - 1)
    assert len(chunks(single)) == EPISODES and chunks(unrecorded) == chunks(single)


def test_a_killed_process_costs_its_chunk_and_a_restart_carries_on(single, unrecorded):
    first, second = start(unrecorded, 2)
    (partial,) = (unrecorded / "run").glob("collect.partial-*")
    while not (partial / "episodes" / "chunk-00001.parquet").exists():  # the first of the second process
        assert second.poll() is None, second.communicate()[1][-3000:]
        time.sleep(0.05)
    second.send_signal(signal.SIGKILL)
    _, errors = first.communicate(timeout=900)
    assert first.returncode == 2
    line = errors.splitlines()[-1]
    assert "expected all 2 processes, got an end of number 1; look at its output, and start all" in line
    recorded = {path.name: path.stat().st_mtime_ns for path in (partial / "episodes").iterdir()}
    assert sorted(recorded) == [f"chunk-0000{number}.parquet" for number in (0, 1, 2, 4)]
    finish(start(unrecorded, 4))
    assert chunks(unrecorded) == chunks(single)
    kept = unrecorded / "run" / "collect" / "episodes"
    assert recorded == {name: (kept / name).stat().st_mtime_ns for name in recorded}


def test_a_fit_is_the_same_to_rounding(tmp_path):
    for processes in (1, 2, 4):
        folder, address = tmp_path / str(processes), free_address()
        folder.mkdir()
        places = [(address, str(processes), str(process)) if processes > 1 else () for process in range(processes)]
        calls = [[sys.executable, str(FIT), str(folder), "4", *place] for place in places]
        finish([open_process(call) for call in calls])
    (single,) = read_fits(tmp_path / "1")
    for processes in (2, 4):
        fits = read_fits(tmp_path / str(processes))
        assert len(fits) == processes and fits[0]["devices"] == 2 * processes
        for name in single.keys() - {"devices"}:
            np.testing.assert_allclose(fits[0][name], single[name], rtol=0, atol=1e-5)
            assert all(np.array_equal(fit[name], fits[0][name]) for fit in fits)


def read_fits(folder: Path) -> list[dict[str, np.ndarray]]:
    return [dict(np.load(path)) for path in sorted(folder.glob("fit-*.npz"))]
