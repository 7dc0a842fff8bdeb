"""Chunks in order through real processes: nothing is lost or doubled, and few are begun ahead of what is taken."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from ballfg.estimation.batch import do_all
from ballfg.parallel.executor import executor
from ballfg.parallel.processes import Processes
from ballfg.parallel.same_versions import own_versions
from ballfg.parallel.stream import AHEAD, HELPED, finished, in_order
from ballfg.parallel.work import KEPT, Work, _functions, compute, packed
from tests.interpreter import fresh

NUMBERS = list(range(60))


def squares(chunk: Sequence[int]) -> list[tuple[int, int]]:
    """The squares, and who computed them."""
    time.sleep(0.005)
    return [(number**2, os.getpid()) for number in chunk]


def square(number: int) -> int:
    return number**2


def slow_square(number: int) -> tuple[int, int]:
    time.sleep(0.2)
    return number**2, os.getpid()


def refused(chunk: Sequence[int]) -> list[int]:
    if 7 in chunk:
        raise ValueError("seven must not be squared")
    return [number**2 for number in chunk]


def ends_its_process(marks: Path, chunk: Sequence[int]) -> list[int]:
    """Ends the worker at the first visit of 11; every visit leaves a mark."""
    first = not list(marks.iterdir())
    if 11 in chunk:
        (marks / f"{time.time_ns()}").touch()
        if first:
            os.kill(os.getpid(), signal.SIGKILL)
    return [number**2 for number in chunk]


def always_ends(own: int, chunk: Sequence[int]) -> list[int]:
    if os.getpid() != own:
        os.kill(os.getpid(), signal.SIGKILL)
    return list(chunk)


def fours(taken: list[int] | None = None) -> Iterator[list[int]]:
    for first in range(0, len(NUMBERS), 4):
        if taken is not None:
            taken.append(first)
        yield NUMBERS[first : first + 4]


def test_results_come_in_order_from_this_process_and_another() -> None:
    found = list(in_order(squares, fours(), Processes(2)))
    assert [value for value, _ in found] == [number**2 for number in NUMBERS]
    assert os.getpid() in {pid for _, pid in found}


def test_the_stream_is_read_no_further_than_the_window_while_nothing_is_taken() -> None:
    taken: list[int] = []
    results = in_order(squares, fours(taken), Processes(2))
    next(results)
    time.sleep(0.3)
    assert len(taken) <= AHEAD + HELPED + 1 < 15
    results.close()
    assert len(taken) < 15


class LoadedLate:
    """Squares, in another process only once a file is there."""

    def __init__(self, own: int, file: Path) -> None:
        self.own, self.file = own, file

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        until = time.monotonic() + 60.0
        while os.getpid() != self.own and not self.file.exists() and time.monotonic() < until:
            time.sleep(0.01)

    def __call__(self, chunk: Sequence[int]) -> list[tuple[int, int]]:
        return squares(chunk)


def test_this_process_does_not_wait_for_one_that_still_loads_its_libraries(tmp_path: Path) -> None:
    Processes(2).stop()
    found = list(in_order(LoadedLate(os.getpid(), tmp_path / "loaded"), fours(), Processes(2)))
    (tmp_path / "loaded").touch()
    assert found == [(number**2, os.getpid()) for number in NUMBERS]


def test_a_stream_that_breaks_off_raises_its_error_and_ends() -> None:
    def broken() -> Iterator[list[int]]:
        yield from list(fours())[:5]
        raise ValueError("the table ends in the middle")

    with pytest.raises(ValueError, match="in the middle"):
        list(in_order(squares, broken(), Processes(2)))


def test_an_error_of_the_function_arrives_as_it_is() -> None:
    with pytest.raises(ValueError, match="seven must not be squared"):
        list(in_order(refused, fours(), Processes(2)))


def test_a_chunk_whose_process_died_is_computed_again(tmp_path: Path) -> None:
    only_others = Processes(1, helped=False)
    found = list(in_order(partial(ends_its_process, tmp_path), fours(), only_others))
    assert found == [number**2 for number in NUMBERS]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_chunk_that_ends_every_process_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ballfg.parallel.processes.MOST_DEATHS", 1)
    with pytest.raises(ChildProcessError, match=r"1 died over a chunk that begins with 5\..*fewer"):
        list(in_order(partial(always_ends, os.getpid()), iter([[5]]), Processes(1, helped=False)))


def test_long_tasks_are_shared_with_this_process() -> None:
    found = do_all([partial(slow_square, number) for number in range(6)], 2)
    assert [value for value, _ in found] == [0, 1, 4, 9, 16, 25]
    assert os.getpid() in {pid for _, pid in found}


def test_long_tasks_hand_their_numbers_over_as_they_finish() -> None:
    found = dict(finished(square, range(5), Processes(1, helped=False)))
    assert found == {number: number**2 for number in range(5)}


def test_an_error_in_another_process_ends_shared_tasks() -> None:
    Processes(1, helped=False).sender(squares)([0]).result()  # one is there
    with pytest.raises(ValueError, match="seven"):
        do_all([partial(_refused_one, os.getpid(), number) for number in range(8)], 2)


def _refused_one(own: int, number: int) -> int:
    time.sleep(0.05)
    if os.getpid() != own:
        raise ValueError("seven must not be squared")
    return number


def asks_for_processes(chunk: Sequence[int]) -> list[bool]:
    import torch

    return [executor(8) is None and torch.get_num_threads() == 1 for _ in chunk]


def test_work_inside_of_a_chunk_stays_there_on_one_thread() -> None:
    assert executor(2) is not None
    assert all(in_order(asks_for_processes, fours(), Processes(2)))


@pytest.mark.parametrize("before", ["", "import torch; torch.set_num_threads(2);"])
def test_torch_has_its_threads_again_where_it_was_imported_meanwhile(before: str) -> None:
    code = (
        "import os; os.environ['OMP_NUM_THREADS'] = '2';" + before + "from ballfg.deferred import one_thread, torch\n"
        "with one_thread():\n    inside = torch.get_num_threads()\n"
        "print(inside, torch.get_num_threads(), os.environ['OMP_NUM_THREADS'])"
    )
    assert fresh(code, check=True).stdout.split() == ["1", "2", "2"]


def test_a_worker_refuses_other_versions_and_keeps_few_functions() -> None:
    work = Work.of(squares)
    with pytest.raises(ValueError, match=r"same versions|must have the versions .*torch .*0\.1"):
        compute(work.name, work.content, packed([2]), own_versions() | {"torch": "0.1"})
    for power in range(KEPT + 2):
        other = Work.of(partial(pow, power))
        compute(other.name, other.content, packed(2), own_versions())
    assert len(_functions) == KEPT
