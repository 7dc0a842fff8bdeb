"""Processes of this machine, by joblib's loky: they are kept for the next work, and replaced when one dies."""

import pickle
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from typing import Any, Final

from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import ProcessPoolExecutor, TerminatedWorkerError

from ballfg.collector import collect_rarely
from ballfg.parallel.same_versions import own_versions
from ballfg.parallel.work import Work, compute, packed

IDLE: Final = 300
"""s after which processes without work end."""
ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
MOST_DEATHS: Final = 3
"""A chunk that lost so many processes is given up: it is probably what ends them."""

warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
"""loky replaces a worker that has grown by 300 MB, as one does that compiles machine code; nobody need hear of it."""

_started: set[int] = set()


class Processes:
    """This process and `jobs` - 1 others; or `jobs` others and this one that waits.

    Args: jobs: number of processes, at least 2.  helped: whether this process is one of them.
    """

    batch = 8

    def __init__(self, jobs: int, *, helped: bool = True) -> None:
        self.helped = helped
        self._others = jobs - 1 if helped else jobs

    @property
    def slots(self) -> int:
        """How many chunks others compute at the same time."""
        return self._others

    @property
    def started(self) -> bool:
        """Whether so many processes were started before; they may be there still."""
        return self._others in _started

    def sender(self, function: Callable[[Sequence[Any]], Any]) -> Callable[[Sequence[Any]], "_Chunk"]:
        """Hands a function of a chunk over; see Executor."""
        _started.add(self._others)
        work = Work.of(function)
        return lambda chunk: _Chunk(self._pool, work, chunk)

    def stop(self) -> None:
        """Ends the processes at once."""
        self._pool().shutdown(wait=True, kill_workers=True)
        _started.clear()

    def _pool(self) -> ProcessPoolExecutor:
        return get_reusable_executor(max_workers=self._others, timeout=IDLE, env=ONE_THREAD, initializer=collect_rarely)


class _Chunk:
    """A chunk that goes to a new process where the one that had it has died."""

    def __init__(self, pool: Callable[[], ProcessPoolExecutor], work: Work, chunk: Sequence[Any]) -> None:
        self._pool, self._first = pool, repr(chunk[0])
        self._call = (compute, work.name, work.content, packed(chunk), own_versions())
        self._future: Future[bytes] = pool().submit(*self._call)

    def done(self) -> bool:
        """Whether the result is there, or the process has died."""
        return self._future.done()

    def result(self) -> Any:
        """The result; see Pending. Raises: ChildProcessError: if the chunk lost too many processes."""
        for _ in range(MOST_DEATHS):
            try:
                return pickle.loads(self._future.result())
            except (TerminatedWorkerError, CancelledError):  # the whole pool ends with one of its processes
                self._future = self._pool().submit(*self._call)
        self.cancel()
        raise ChildProcessError(
            f"processes must live while they work; {MOST_DEATHS} died over a chunk that begins with {self._first}. "
            "Memory is probably short: use fewer processes."
        )

    def cancel(self) -> bool:
        """Gives the chunk up where no process has begun it."""
        return self._future.cancel()
