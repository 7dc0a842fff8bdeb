"""Progress of long work: nothing for short work, then lines now and then."""

from __future__ import annotations

import sys
import time

import pytest

from ballfg import progress as progress_module
from ballfg.progress import alive, announce, be_quiet, counted, doing, idle, progress, unwatched


class Clock:
    """Time that passes as a test says."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture(autouse=True)
def loud(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(progress_module.VARIABLE)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress_module, "time", made)
    return made


def work(clock: Clock, start: float, each: float, total: int) -> list[int]:
    def items() -> object:
        clock.now += start
        for i in range(total):
            clock.now += each
            yield i

    return list(progress(items(), total, "tracks estimated"))  # type: ignore[arg-type]


def test_short_work_is_quiet(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    assert work(clock, 0.5, 0.1, 14) == list(range(14))
    assert capsys.readouterr().err == ""


def test_the_start_does_not_count_as_work(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    """10 s until processes run, then 0.5 s a track: the first line tells no time, the second the right one."""
    work(clock, 10.0, 0.5, 88)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["1 of 88 tracks estimated", "6 of 88 tracks estimated, 41 s left"]
    assert len(lines) == 18  # one in 2.5 s


def test_unwatched_work_is_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(unwatched(range(3), 3, "tracks estimated")) == [0, 1, 2]
    assert capsys.readouterr().err == ""


def test_quiet_work_is_quiet(clock: Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(progress_module.VARIABLE, "")
    be_quiet()
    assert work(clock, 10.0, 0.5, 88) == list(range(88))
    announce("fitting")
    assert capsys.readouterr().err == ""


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds become hundredths."""
    monkeypatch.setattr(progress_module, "LINE_EVERY", 0.05)
    monkeypatch.setattr(progress_module, "BEAT", 0.01)


def test_a_stage_that_lasts_is_named_again_and_again(hurried: None, capsys: pytest.CaptureFixture[str]) -> None:
    """The innermost stage, and what was announced last; nothing while somebody else speaks, or once it is over."""
    with alive("ballfg test"):
        time.sleep(0.2)
        with doing("compiling"):
            time.sleep(0.2)
        announce("describing what is left")
        time.sleep(0.2)
        with idle():
            before = capsys.readouterr().err.splitlines()
            time.sleep(0.2)
            assert capsys.readouterr().err == ""
    time.sleep(0.1)
    assert capsys.readouterr().err == ""
    assert list(dict.fromkeys(before)) == [
        "ballfg test: 0 s so far",
        "compiling: 0 s so far",
        "describing what is left",
        "describing what is left: 0 s so far",
    ]
    assert all(before.count(line) >= 2 for line in before if "so far" in line)


def test_items_that_take_long_are_alive_too(hurried: None, capsys: pytest.CaptureFixture[str]) -> None:
    with alive("ballfg test"):
        for _ in progress([1, 2], 2, "tracks estimated"):
            time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert lines.count("tracks estimated: 0 s so far") >= 2
    assert lines.count("1 of 2 tracks estimated: 0 s so far") >= 2


def test_a_program_without_stderr_sees_no_progress(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one with a window on Windows: a message would go to stdout, and a bar would fail."""
    monkeypatch.setattr(sys, "stderr", None)
    for _ in progress(range(3), 3, "things"):
        clock.now += 10.0


@pytest.mark.parametrize(("number", "said"), [(0, "0 tracks"), (1, "1 track"), (2, "2 tracks")])
def test_a_number_has_its_noun(number: int, said: str) -> None:
    assert counted(number, "track") == said


def test_a_resumed_stage_counts_all_of_its_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: clock[0])
    elapsed = []
    for _ in range(2):
        with doing("compiling functions", resumed=True) as outer:
            clock[0] += 3.0
            with doing("compiling functions", resumed=True) as inner:
                clock[0] += 2.0
                elapsed.append(clock[0] - inner.since)
            assert inner is outer
        clock[0] += 50.0  # of other work
    assert elapsed == [5.0, 10.0]
    with doing("compiling functions") as anew:
        assert anew.since == clock[0]
