"""Signals end a command within two seconds, whatever it is doing."""

import contextlib
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from lgmdjax.cli.main import exit_code
from lgmdjax.runtime import interruption

DOING = {
    "waiting": "time.sleep(60)",
    "swallowing": """
        while True:
            try:
                time.sleep(0.01)
            except KeyboardInterrupt:
                pass  # as the garbage collector does with what a callback raises
    """,
    "compiled": "import hashlib; hashlib.pbkdf2_hmac('sha256', b'', b'', 2**30)",  # minutes, without any of Python
    "looping": """
        while True:
            try:
                time.sleep(0.01)
            except KeyboardInterrupt:
                pass
            interruption.check()
    """,
}


@pytest.mark.parametrize(
    ("doing", "number"),
    [*((doing, signal.SIGINT) for doing in DOING), ("waiting", signal.SIGTERM), ("waiting", signal.SIGHUP)],
)
def test_a_command_ends_within_two_seconds(doing: str, number: signal.Signals) -> None:
    script = (
        "import signal, sys, time\nfrom lgmdjax.cli.main import exit_code\nfrom lgmdjax.runtime import interruption\n"
    )
    script += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which a shell's background jobs ignore
    script += "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # and those of nohup
    script += (
        f"def command():\n    print(flush=True)\n{textwrap.indent(textwrap.dedent(DOING[doing]).strip(), '    ')}\n"
    )
    script += "sys.exit(exit_code(command))\n"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        time.sleep(0.2)  # into the command
        process.send_signal(number)
        try:
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()  # else the block would wait for it
    assert process.returncode == 128 + number
    assert errors.decode().split("\n")[-2] == "lgmdjax: interrupted; the same command resumes"
    assert b"Traceback" not in errors


def test_handlers_are_those_of_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert exit_code(lambda: 3) == 3
    with pytest.raises(ZeroDivisionError), interruption.handling_signals(""):
        raise ZeroDivisionError
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    interruption.check()


def test_an_exception_that_got_lost_is_raised_by_the_next_look() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job ignores
    with pytest.raises(interruption.Interrupted, match="SIGINT"), interruption.handling_signals(""):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        interruption.check()
    signal.signal(signal.SIGINT, before)


def test_ignored_signals_stay_ignored() -> None:
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruption.handling_signals(""):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
