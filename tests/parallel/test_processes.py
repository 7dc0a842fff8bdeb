"""Processes of this machine: they end with the one that started them, and tell what they do."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from ballfg.parallel.processes import Processes
from ballfg.parallel.stream import in_order
from ballfg.parallel.worker import tell
from tests.places import ROOT

STARTED = """
import os
import re
import signal
import sys
import time
from ballfg.parallel.processes import Processes

def work(chunk):
    os.write(1, f"{{os.getpid()}}\\n".encode())  # whole lines, whoever else writes
    time.sleep(chunk[0])
    return chunk

send = Processes(2, helped=False).sender(work)
pending = [send([{seconds}]) for _ in range(2)]
{then}
time.sleep(60)
"""
FORKED = "while len(pending) and not all(one.done() for one in pending): time.sleep(0.01)\nos.fork()"


def started(seconds: float, then: str = "") -> tuple[subprocess.Popen[str], list[int]]:
    """A process that has started two others, and their numbers."""
    process = subprocess.Popen(
        [sys.executable, "-c", STARTED.format(seconds=seconds, then=then)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stdout is not None
    return process, [int(process.stdout.readline()) for _ in range(2)]


def lives(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


def gone(processes: Sequence[int]) -> bool:
    """Whether processes end within 5 s."""
    deadline = time.monotonic() + 5.0
    while any(map(lives, processes)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not any(map(lives, processes))


@pytest.mark.parametrize(
    ("seconds", "then"), [(60.0, ""), pytest.param(0.0, "", marks=pytest.mark.thorough), (0.0, FORKED)]
)
@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.thorough)])
def test_processes_end_with_the_one_that_started_them(seconds: float, then: str, number: signal.Signals) -> None:
    """While they work, while they wait, and while they wait and a copy of the other one lives on."""
    process, others = started(seconds, then)
    try:
        assert all(map(lives, others))
        time.sleep(0.3)
        process.send_signal(number)
        process.wait(10)
        assert gone(others)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert not [path for path in Path("/dev/shm").glob(f"*{process.pid}*")]


def test_ctrl_c_at_the_terminal_is_for_the_process_that_asks() -> None:
    """The others get it too; they say nothing."""
    process, others = started(60.0)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=20)[1]
    assert said.count("Traceback") == 1
    assert "KeyboardInterrupt" in said
    assert gone(others)


def told(chunk: Sequence[int]) -> int:
    for number in chunk:
        tell(number)
    return sum(chunk)


def test_what_a_process_tells_arrives_before_its_result() -> None:
    heard: list[int] = []
    pending = Processes(1, helped=False).sender(told, heard.append)([1, 2, 3])
    assert pending.result() == 6
    assert heard == [1, 2, 3]


def fails(chunk: Sequence[int]) -> None:
    raise ValueError(f"{chunk[0]} must not be")


class UncopiedError(Exception):
    def __init__(self, one: int, other: int) -> None:
        super().__init__("two are needed")


def fails_oddly(chunk: Sequence[int]) -> None:
    raise UncopiedError(1, 2)


def leaves(chunk: Sequence[int]) -> None:
    sys.exit(0)


@pytest.mark.parametrize(
    ("function", "error", "words"),
    [
        (fails, ValueError, "^7 must not be$"),
        (fails_oddly, RuntimeError, "UncopiedError: two are needed"),
        (leaves, ChildProcessError, "must return or raise.*SystemExit"),
    ],
)
def test_an_error_keeps_the_lines_where_it_was_raised(function: object, error: type[Exception], words: str) -> None:
    with pytest.raises(error) as raised:
        Processes(1, helped=False).sender(function)([7]).result()  # type: ignore[arg-type]
    assert re.search(words, str(raised.value))
    assert "test_processes.py" in "".join([str(raised.value), *getattr(raised.value, "__notes__", [])])


def doubled(chunk: Sequence[int]) -> list[int]:
    time.sleep(0.01)
    return [2 * number for number in chunk]


def test_two_streams_with_other_numbers_of_processes_do_not_disturb_each_other() -> None:
    def numbers() -> Iterator[list[int]]:
        for number in range(30):
            yield [number]

    one, other = in_order(doubled, numbers(), Processes(2)), in_order(doubled, numbers(), Processes(3, helped=False))
    assert [pair for pair in zip(one, other, strict=True)] == [(2 * k, 2 * k) for k in range(30)]


def test_after_a_stop_the_next_work_starts_new_processes() -> None:
    before = Processes(1, helped=False).sender(_where)([0]).result()
    Processes(1, helped=False).stop()
    after = Processes(1, helped=False).sender(_where)([0]).result()
    assert before != after
    assert gone([before])


def _where(_chunk: Sequence[int]) -> int:
    return os.getpid()


def folder(chunk: Sequence[int]) -> str:
    return os.getcwd()


def test_a_process_that_was_started_elsewhere_works_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relative paths mean the same in all processes."""
    assert Processes(1, helped=False).sender(folder)([0]).result() == os.getcwd()
    monkeypatch.chdir(tmp_path)
    assert Processes(1, helped=False).sender(folder)([0]).result() == str(tmp_path.resolve())


def test_a_process_that_starts_early_loads_a_module_and_does_the_later_work() -> None:
    """Its number is that of the process that computes; the module is there before any work asks for it."""
    processes = Processes(1, helped=False)
    send = processes.sender(_seen)
    begun, _ = send(["colorsys"]).result()
    processes.start("colorsys")
    deadline = time.monotonic() + 60.0
    while not send(["colorsys"]).result()[1]:
        assert time.monotonic() < deadline
    assert send(["colorsys"]).result() == (begun, True)


def _seen(chunk: Sequence[str]) -> tuple[int, bool]:
    return os.getpid(), chunk[0] in sys.modules
