"""Processes that find each other, and what each of them does; no simulation."""

import json
import socket
import subprocess
import sys
import threading
import time

import pytest

from lgmdjax.errors import InputError
from lgmdjax.runtime import distributed, rendezvous
from lgmdjax.runtime.rendezvous import Member


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def meet(address: str, members: list[Member], seconds: float = 20.0) -> list[str]:
    """Let some processes, here threads, meet; return the error of each, or an empty text."""
    faults = [""] * len(members)

    def run(index: int) -> None:
        try:
            rendezvous.meet(address, members[index], seconds)
        except InputError as error:
            faults[index] = str(error)

    threads = [threading.Thread(target=run, args=(index,)) for index in range(len(members))]
    for thread in threads:
        thread.start()
        time.sleep(0.02)  # in this order
    for thread in threads:
        thread.join()
    return faults


def members(numbers: list[int], processes: int) -> list[Member]:
    return [Member(process=number, processes=processes, task="collect smoke-0") for number in numbers]


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 2, 1, 0]])
def test_processes_meet_in_any_order_and_free_the_port(order: list[int]) -> None:
    address = free_address()
    assert meet(address, members(order, 4)) == [""] * 4
    host, port = rendezvous.split_address(address)
    socket.create_server((host, port)).close()


def test_the_second_of_one_number_is_refused_and_the_others_go_on() -> None:
    faults = meet(free_address(), members([0, 1, 1, 2], 3))
    assert faults == ["", "", "expected one process of number 1, got two; give each process its own --process", ""]


def test_a_process_that_was_killed_at_the_start_may_be_started_again() -> None:
    address = free_address()
    host, port = rendezvous.split_address(address)
    first = threading.Thread(target=meet, args=(address, members([0], 3)))
    first.start()
    time.sleep(0.1)
    with socket.create_connection((host, port)) as killed:
        killed.sendall(json.dumps(vars(members([1], 3)[0])).encode() + b"\n")
        time.sleep(0.1)
    assert meet(address, members([1, 2], 3)) == ["", ""]
    first.join()


def test_a_missing_process_is_named_in_all_others() -> None:
    faults = meet(free_address(), members([0, 2], 4), seconds=0.5)
    line = "expected 4 processes within 0.5 s, got none with number 1, 3; start all with the same --processes"
    assert faults == [line, line]


def test_without_process_0_the_others_end_after_the_time_limit() -> None:
    address = free_address()
    (fault,) = meet(address, members([1], 2), seconds=0.5)
    assert fault.startswith(f"expected process 0 at {address} within 0.5 s, got none (") and "--coordinator" in fault


def test_processes_of_different_runs_are_refused() -> None:
    other = [
        Member(process=1, processes=3, task="collect smoke-0"),
        Member(process=1, processes=2, task="train quick-0"),
    ]
    faults = meet(free_address(), [*members([0], 2), *other], seconds=0.5)
    assert "expected processes 2 as in process 0, got 3" in faults[1]
    assert "expected task collect smoke-0 as in process 0, got train quick-0" in faults[2]


def test_two_of_number_0_do_not_share_a_port() -> None:
    faults = meet(free_address(), members([0, 0, 1], 2))
    assert sorted(map(bool, faults)) == [False, False, True] and "expected a free port" in "".join(faults)


def test_something_else_at_the_address_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection = server.accept()[0]
            connection.recv(1000)
            connection.sendall(b"HTTP/1.1 400\n")
            connection.close()

        threading.Thread(target=answer, daemon=True).start()
        (fault,) = meet(f"127.0.0.1:{server.getsockname()[1]}", members([1], 2), seconds=2)
    assert "got another service" in fault and "another process of number 1" in fault


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (("", None, None), "expected SLURM or Open MPI, or --coordinator"),
        (("node:1", 2, None), "expected all of --coordinator, --processes and --process"),
        (("node", 2, 0), "expected --coordinator HOST:PORT, got 'node'"),
        (("node:70000", 2, 0), "expected --coordinator HOST:PORT"),
        (("node:1", 2, 2), "expected a --process of 0 to 1, got 2"),
    ],
)
def test_impossible_places_are_refused(given, match) -> None:
    with pytest.raises(InputError, match=match):
        distributed.start(*given)


def test_slurm_and_open_mpi_say_the_place(monkeypatch) -> None:
    slurm = {"JOB_ID": "8192", "STEP_NODELIST": "node[07-09]", "NTASKS": "12", "PROCID": "5", "LOCALID": "1"}
    for name, value in slurm.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    assert distributed._place("", None, None) == ("node07:61440", 12, 5, [1])
    for name in slurm:
        monkeypatch.delenv(f"SLURM_{name}")
    monkeypatch.setenv("OMPI_MCA_orte_hnp_uri", "4096.0;tcp://10.0.0.1:34911")
    for name, value in {"SIZE": "3", "RANK": "2", "LOCAL_RANK": "0"}.items():
        monkeypatch.setenv(f"OMPI_COMM_WORLD_{name}", value)
    assert distributed._place("", None, None) == ("10.0.0.1:61441", 3, 2, [0])


def test_a_single_process_does_everything_and_waits_for_nobody(tmp_path) -> None:
    distributed.start("127.0.0.1:1", 1, 0)  # where nothing listens
    assert (distributed.number(), distributed.count(), distributed.is_first()) == (0, 1, True)
    assert distributed.deal([3, 5, 8]) == [3, 5, 8]
    distributed.wait("here")
    distributed.await_files([tmp_path / "missing"])
    assert distributed.share("here", lambda: {"a": 1}) == {"a": 1}
    distributed.leave("whatever")


def test_each_item_is_dealt_once(monkeypatch) -> None:
    dealt = []
    for number in range(4):
        monkeypatch.setattr(distributed, "_group", distributed._Group(number=number, count=4, client=None))
        dealt.append(distributed.deal(range(10)))
        with distributed.alone():
            assert distributed.is_first() and distributed.deal([1, 2]) == [1, 2]
    assert dealt == [[0, 4, 8], [1, 5, 9], [2, 6], [3, 7]]


def test_files_that_do_not_appear_end_the_wait(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(distributed, "_group", distributed._Group(number=1, count=2, client=None))
    with pytest.raises(
        InputError, match=r"expected .*run.json from another process within 0.1 s, got none; put --out on"
    ):
        distributed.await_files([tmp_path / "run.json"], seconds=0.1)


PROGRAM = """
import os, signal, sys, time
import numpy as np
from lgmdjax.errors import InputError
from lgmdjax.runtime import distributed
distributed.HEARTBEAT = 8
number, count, address, mode = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4]
distributed.start(address, count, number, seconds=60)
fault = ""
try:
    print(distributed.share("first", lambda: [7, number]), distributed.deal([0, 1, 2, 3, 4]), flush=True)
    tree = distributed.share_arrays("second", {"a": np.arange(3.0) + number, "b": np.asarray([np.nan, -0.0])})
    print(np.asarray(tree["a"]).tolist(), np.signbit(tree["b"][1]), flush=True)
    distributed.only_first("third", lambda: print("alone", distributed.count(), flush=True))
    if mode == "kill" and number == count - 1:
        os.kill(os.getpid(), signal.SIGKILL)
    if mode == "fail" and number == 0:
        raise InputError("expected a, got b; do c")
    distributed.wait("fourth")
    print("done", flush=True)
except InputError as error:
    fault = "" if isinstance(error, distributed.OtherProcessError) else str(error)
    print(error, flush=True)
distributed.leave(fault)
"""


def run_processes(count: int, mode: str) -> list[tuple[int, list[str]]]:
    """Run processes of `PROGRAM`; return the exit code and the printed lines of each."""
    address = free_address()
    started = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(number), str(count), address, mode],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(count)
    ]
    outputs = [process.communicate(timeout=300) for process in started]
    return [(process.returncode, out.splitlines()) for process, (out, _) in zip(started, outputs, strict=True)]


def test_processes_share_values_and_end_together() -> None:
    first, second = run_processes(2, "well")
    assert first == (0, ["[7, 0] [0, 2, 4]", "[0.0, 1.0, 2.0] True", "alone 1", "done"])
    assert second == (0, ["[7, 0] [1, 3]", "[0.0, 1.0, 2.0] True", "done"])


@pytest.mark.extended
def test_a_fault_and_a_death_end_all_processes_with_one_line() -> None:
    results = run_processes(3, "fail")
    assert [lines[-1] for _, lines in results] == [
        "expected a, got b; do c", *["process 0: expected a, got b; do c"] * 2
    ]  # fmt: skip
    *others, (code, _) = run_processes(3, "kill")
    assert code == -9
    for code, lines in others:
        assert code == 0 and lines[-1].startswith("fourth: expected all 3 processes, got an end of number 2; look at")
