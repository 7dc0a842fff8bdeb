"""Ctrl-C, SIGTERM and SIGHUP end a program in one way, wherever it is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ballfg import interrupts
from tests.places import ROOT

IN_WORK = """
def run():
    print("ready", flush=True)
    time.sleep(60)
"""
IN_IMPORT = """
print("ready", flush=True)
time.sleep(60)
"""
CLEANED_UP = """
def run():
    try:
        print("ready", flush=True)
        time.sleep(60)
    finally:
        print("cleaning", flush=True)
        time.sleep(0.5)
        print("clean", flush=True)
"""
IN_A_DYING_OBJECT = """
class Dying:
    def __del__(self):
        print("ready", flush=True)
        time.sleep(60)

def run():
    thing = Dying()
    del thing
    time.sleep(60)
"""
MADE_ANOTHER_ERROR = """
def run():
    try:
        print("ready", flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        raise ImportError("initialization failed")
"""
ENDS_BY_ITSELF = """
import atexit

class Kept:
    def __del__(self):
        print("shut down by Python")

kept = Kept()

def run():
    atexit.register(print, "ended")
    print("ready", flush=True)
    print("answer")
    print("note", end="", file=sys.stderr)
    sys.exit(3)
"""
GUARDED = """
from ballfg.cli.start import guarded

def work():
    try:
        print("ready", flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        raise ValueError("cancelled")

def run():
    sys.exit(guarded(work))
"""


@pytest.fixture
def program(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Starts a program with some code, and waits until it says that it is ready."""

    def started(code: str, ignored: int = 0) -> subprocess.Popen[str]:
        (tmp_path / "slow.py").write_text(f"import sys\nimport time\n{code}")

        def before() -> None:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            if ignored:
                signal.signal(ignored, signal.SIG_IGN)

        process = subprocess.Popen(
            [sys.executable, "-c", "from ballfg.cli.entry import _run; _run('slow')"],
            env=os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=before,
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    return started


@pytest.mark.parametrize(
    ("code", "number", "line"),
    [
        (IN_WORK, signal.SIGINT, "ballfg: interrupted\n"),
        (IN_WORK, signal.SIGHUP, "ballfg: interrupted by SIGHUP\n"),
        *(
            (code, signal.SIGTERM, "ballfg: interrupted by SIGTERM\n")
            for code in (IN_WORK, IN_IMPORT, IN_A_DYING_OBJECT, MADE_ANOTHER_ERROR, GUARDED)
        ),
    ],
)
def test_a_signal_is_one_line_and_a_status(
    program: Callable[..., subprocess.Popen[str]], code: str, number: signal.Signals, line: str
) -> None:
    process = program(code)
    process.send_signal(number)
    assert process.communicate(timeout=20) == ("", line)
    assert process.returncode == 128 + number


def test_further_signals_do_not_cut_cleaning_up_short(program: Callable[..., subprocess.Popen[str]]) -> None:
    process = program(CLEANED_UP)
    process.send_signal(signal.SIGTERM)
    assert process.stdout is not None
    assert process.stdout.readline() == "cleaning\n"
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        process.send_signal(number)
    assert process.communicate(timeout=20) == ("clean\n", "ballfg: interrupted by SIGTERM\n")
    assert process.returncode == 128 + signal.SIGTERM


def test_what_is_ignored_stays_ignored(program: Callable[..., subprocess.Popen[str]]) -> None:
    """As nohup does."""
    process = program(IN_WORK, ignored=signal.SIGHUP)
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=20) == ("", "ballfg: interrupted by SIGTERM\n")


def test_code_that_raises_an_interrupt_by_itself_is_not_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert interrupts.is_interrupt(KeyboardInterrupt())  # Python's own handler has raised it, for all we know
    monkeypatch.setattr(interrupts, "_listening", True)
    assert not interrupts.is_interrupt(KeyboardInterrupt())
    monkeypatch.setattr(interrupts, "_number", signal.SIGINT)
    assert interrupts.is_interrupt(KeyboardInterrupt())
    assert not interrupts.is_interrupt(SystemExit())


def test_a_program_that_ends_by_itself_says_all_and_leaves_python_nothing_to_shut_down(
    program: Callable[..., subprocess.Popen[str]],
) -> None:
    with program(ENDS_BY_ITSELF) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.read() == "answer\nended\n"
        assert process.stderr.read() == "note"
    assert process.returncode == 3
