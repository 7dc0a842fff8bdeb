"""Threads of one process, such as one for each camera or ball: they may share models and estimators. And its forks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.dynamics import nominal_model
from ballfg.estimation import ExtendedKalmanFilter, Online, Settings, Smoother
from ballfg.parallel.parts import AHEAD, in_threads, read_ahead, with_jobs
from ballfg.simulation import SimulationConfig, simulate
from ballfg.simulation.balls import table_tennis
from ballfg.tracks import Track
from tests.places import ROOT

THREADS = 6
FIRST_CALLS = """
import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
import numpy as np
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Settings, Smoother
from ballfg.tracks import Track

sys.setswitchinterval(1e-5)
times = np.arange(20) / 100.0
track = Track(times, np.stack((-1.0 + 3.0 * times, 0.1 * times, 0.4 + times - 4.9 * times**2), axis=1))
begin = Barrier(6)

def estimated(_):
    model = nominal_model()
    smoother = Smoother(model, Surfaces.table_tennis(0.0), Settings.for_measured(model, position_noise=(0.003,) * 3))
    begin.wait()
    return smoother.estimate(track).predict(0.3).positions[-1, 0]

with ThreadPoolExecutor(6) as pool:
    found = set(pool.map(estimated, range(6)))
print(len(found))
begin = Barrier(1)
assert found == {estimated(0)}
child = os.fork()
if child == 0:
    signal.alarm(60)  # ends it: torch would wait for threads that a fork does not have
    os._exit(found != {estimated(0)})
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads that take turns a thousand times as often as usual."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return [shot.track for shot in simulate(SimulationConfig(tracks=THREADS, rate=60.0, seed=8))]


def estimates() -> dict[str, Callable[[Track], Array]]:
    """Results of a track by objects that all threads share."""
    model = nominal_model()
    table = table_tennis().surfaces
    settings = Settings.for_measured(model, position_noise=(0.003,) * 3)
    smoother, ekf = Smoother(model, table, settings), ExtendedKalmanFilter(model, table, settings)

    def streamed(track: Track) -> Array:
        online = Online(model, table, settings)
        return np.array([online.push(t, p).covariance for t, p in zip(track.times, track.positions, strict=True)])

    return {
        "smoother": lambda track: smoother.estimate(track).covariances,
        "ekf": lambda track: ekf.estimate(track).covariances,
        "stream": streamed,
    }


@pytest.mark.parametrize("method", ["smoother", "ekf", "stream"])
@pytest.mark.usefixtures("restless")
def test_threads_get_what_one_gets(tracks: list[Track], method: str) -> None:
    estimated = estimates()[method]
    alone = [estimated(track) for track in tracks]
    begin = Barrier(THREADS)

    def together(track: Track) -> Array:
        begin.wait()
        return estimated(track)

    with ThreadPoolExecutor(THREADS) as pool:
        for one, other in zip(alone, pool.map(together, tracks), strict=True):
            np.testing.assert_array_equal(one, other)


def test_the_first_estimates_of_a_process_may_begin_together_and_then_a_fork_makes_one() -> None:
    """Each function is compiled, or loaded, by the first that needs it; none leaves threads of torch's waiting."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", "-c", FIRST_CALLS],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "1\n0\n", "")


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_stream_in_threads_keeps_its_order_and_a_few_items_only(jobs: int) -> None:
    """The first of each three waits for the other two: on fewer threads it would wait in vain."""
    begun, together, most = list[int](), Barrier(jobs), list[int]()

    def stream() -> Iterator[int]:
        for number in range(9 * jobs):
            begun.append(number)
            yield number

    def squared(number: int) -> int:
        together.wait(timeout=30.0)
        return number**2

    def consumed(_: None) -> list[int]:
        found = []
        for one in in_threads(squared, stream()):
            most.append(len(begun) - len(found))
            found.append(one)
        return found

    assert with_jobs(jobs, consumed, None) == [number**2 for number in range(9 * jobs)]
    assert max(most) <= 2 * jobs + 1

    def wrong(number: int) -> int:
        return 1 // (number - 2)

    with pytest.raises(ZeroDivisionError):
        with_jobs(jobs, lambda _: list(in_threads(wrong, range(9))), None)


def test_another_thread_reads_a_few_items_ahead_and_leaves_with_the_reader() -> None:
    read, closed = list[int](), list[bool]()

    def numbers() -> Generator[int, None, None]:
        try:
            for number in range(30):
                read.append(number)
                yield number
        finally:
            closed.append(True)

    assert list(read_ahead(numbers())) == list(range(30))
    read.clear()
    items = read_ahead(numbers())
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    items.close()
    assert len(read) <= 3 + AHEAD
    assert closed == [True, True]


def test_an_error_of_what_is_read_ahead_comes_after_the_items_before_it() -> None:
    def broken() -> Generator[int, None, None]:
        yield from range(6)
        raise ValueError("the file ends in the middle")

    seen = list[int]()
    with pytest.raises(ValueError, match="in the middle"):
        seen.extend(read_ahead(broken()))
    assert seen == list(range(6))
