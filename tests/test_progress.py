"""Progress of long work: nothing for short work, then lines now and then."""

from __future__ import annotations

import pytest

from ballfg import progress as progress_module
from ballfg.progress import progress, unwatched


class Clock:
    """Time that passes as a test says."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


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
    assert lines[:2] == ["1 of 88 tracks estimated", "21 of 88 tracks estimated, 34 s left"]
    assert len(lines) == 5


def test_unwatched_work_is_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(unwatched(range(3), 3, "tracks estimated")) == [0, 1, 2]
    assert capsys.readouterr().err == ""
