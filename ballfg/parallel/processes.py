"""Computes chunks in processes of this machine, which are reused, replaced after a crash, and end with this process.

Each is an interpreter with two pipes: one for calls and answers, and its standard input, to which only this process can
write. When this process ends, however it ends, the system closes them, and the other process ends too (`worker.py`).
Nothing else can remain: no semaphore, no file, no supervising process.
"""

import atexit
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from multiprocessing import Pipe
from queue import SimpleQueue
from typing import IO, Any, Final, cast

from ballfg.parallel.same_versions import own_versions
from ballfg.parallel.work import Work, loaded, packed

ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
MOST_DEATHS: Final = 3  # largest number of processes that a chunk may lose: it is then the probable cause
BEGIN: Final = "import sys; exec(sys.stdin.readline())"  # code of a process; the line that it reads finds our modules
Told = Callable[[Any], object]


class Processes:
    """This process and `jobs` - 1 others; or `jobs` others while this one waits.

    Args: jobs: number of processes, at least 2.  helped: True if this process is one of them.
    """

    batch = 8

    def __init__(self, jobs: int, *, helped: bool = True) -> None:
        self.helped = helped
        self.slots = jobs - 1 if helped else jobs  # chunks that others compute at the same time

    @property
    def started(self) -> bool:
        """True if this number of processes was started before; they may still exist."""
        return _crew.size >= self.slots

    def start(self, module: str) -> None:
        """Starts them; each imports a module and what this needs, while the calling process does something else."""
        send = self.sender(loaded)
        for _ in range(self.slots):
            send([module])

    def sender(
        self, function: Callable[[Sequence[Any]], Any], told: Told | None = None
    ) -> Callable[[Sequence[Any]], "_Chunk"]:
        """Submits a function of a chunk; see Executor. `told` gets, in another thread, what `worker.tell` sends."""
        work = Work.of(function)
        return lambda chunk: _Chunk(_crew.line(self.slots), work, chunk, told)

    def stop(self) -> None:
        """Ends all processes at once."""
        _stop()


class _Chunk:
    """A chunk that goes to a new process if the first one dies."""

    def __init__(self, line: "_Line", work: Work, chunk: Sequence[Any], told: Told | None) -> None:
        self._first, self._told, self._work = repr(chunk[0]), told, work
        self._call = _call(work, packed(chunk))
        self._future = Future[tuple[str, bytes]]()
        line.put(self)

    def done(self) -> bool:
        """True if the result, or an error, is there."""
        return self._future.done()

    def result(self) -> Any:
        """The result; see Pending. Raises: ChildProcessError: the chunk lost too many processes."""
        kind, content = self._future.result()
        found = pickle.loads(content)
        if kind == "error":
            raise found
        return found

    def cancel(self) -> bool:
        """Cancels the chunk unless a process has begun it."""
        return self._future.cancel()

    def compute(self, crew: "_Crew") -> None:
        """Computes it in a process; until there is one that has loaded its function, the chunk can be cancelled."""
        if not self._future.cancelled():
            crew.get_ready(self._work)
        if self._future.set_running_or_notify_cancel():
            try:
                self._future.set_result(self._answered(crew))
            except BaseException as error:  # raised where the result is asked for
                self._future.set_exception(error)

    def _answered(self, crew: "_Crew") -> tuple[str, bytes]:
        for _ in range(MOST_DEATHS):
            process = crew.taken()
            with suppress(EOFError, OSError):  # it has died
                answer = process.answer(self._call, self._told)
                crew.put_back(process)
                return answer
            crew.bury(process)
        problem = f"processes must live while they work; {MOST_DEATHS} died over a chunk that begins with {self._first}"
        raise ChildProcessError(f"{problem}. Memory is probably short: use fewer processes.")


def _call(work: Work, chunk: bytes | None) -> bytes:
    """A call of a process: to compute a packed chunk, or only to load its function."""
    return pickle.dumps((os.getcwd(), work.name, work.content, chunk, own_versions()))


_Line = SimpleQueue[_Chunk | None]


class _Crew:
    """All processes, and the waiting chunks: a queue for each requested number of processes."""

    def __init__(self) -> None:
        self._processes: set[_Process] = set()
        self._free: list[_Process] = []
        self._lines: dict[int, _Line] = {}
        self._lock = threading.RLock()
        self._stopped = False

    @property
    def size(self) -> int:
        return len(self._processes)

    def line(self, size: int) -> _Line:
        """The queue of a number of processes, served by as many threads."""
        with self._lock:
            if size not in self._lines:
                self._lines[size] = SimpleQueue()
                for _ in range(size):
                    threading.Thread(target=self._work, args=(self._lines[size],), daemon=True).start()
            return self._lines[size]

    def _work(self, line: _Line) -> None:
        while (chunk := line.get()) is not None:
            chunk.compute(self)

    def taken(self) -> "_Process":
        """A process for one chunk. Raises: CancelledError: all processes were ended."""
        with self._lock:
            if self._stopped:
                raise CancelledError
            while self._free:
                process = self._free.pop()
                if process.lives():
                    return process
                self.bury(process)
            process = _Process()
            self._processes.add(process)
            return process

    def get_ready(self, work: Work) -> None:
        """Starts a process if none is free, and lets it load its libraries with a function; what fails shows later."""
        with suppress(CancelledError):
            process = self.taken()
            try:
                if process.fresh:
                    process.answer(_call(work, None), None)
                    process.fresh = False
            except (EOFError, OSError):  # it has died
                self.bury(process)
            else:
                self.put_back(process)

    def put_back(self, process: "_Process") -> None:
        with self._lock:
            if self._stopped:
                self.bury(process)
            else:
                self._free.append(process)

    def bury(self, process: "_Process") -> None:
        with self._lock:
            process.kill()
            process.close()
            self._processes.discard(process)

    def stop(self) -> None:
        """Ends all processes; waiting threads find that theirs has died."""
        with self._lock:
            self._stopped = True
            for process in self._processes:
                process.kill()
            while self._free:
                self.bury(self._free.pop())
            for size, line in self._lines.items():
                for _ in range(size):
                    line.put(None)

    def forget(self) -> None:
        """Closes the pipes of a copy of this process, which must neither keep the others alive nor use them."""
        for process in self._processes:
            process.close()


class _Process:
    fresh = True  # It has loaded no function yet

    def __init__(self) -> None:
        self._calls, theirs = Pipe()
        # Ctrl-C at the terminal is for this process alone; the other one ignores it as soon as it can
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-c", BEGIN],
                    stdin=subprocess.PIPE,
                    pass_fds=[handle := theirs.fileno()],
                    env=os.environ | ONE_THREAD,
                    text=True,
                )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with suppress(OSError):  # it died at once: its first call reports that
            print(
                f"sys.path[:] = {sys.path!r}; from ballfg.parallel.worker import serve; serve({handle})",
                file=self._process.stdin,
                flush=True,
            )

    def lives(self) -> bool:
        return self._process.poll() is None

    def answer(self, call: bytes, told: Told | None) -> tuple[str, bytes]:
        """The answer of the process to a call. Raises: EOFError, OSError: it has died."""
        self._calls.send_bytes(call)
        while True:
            kind, content = pickle.loads(self._calls.recv_bytes())
            if kind != "told":
                return kind, content
            if told is not None:
                told(content)

    def kill(self) -> None:
        """Ends it at once; a waiting thread finds that it has died."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """Closes its pipes."""
        self._calls.close()
        with suppress(OSError):
            cast("IO[str]", self._process.stdin).close()


_crew = _Crew()


def _stop() -> None:
    global _crew
    _crew, ended = _Crew(), _crew
    ended.stop()


def _forget() -> None:
    global _crew
    _crew, others = _Crew(), _crew
    others.forget()


atexit.register(_stop)
os.register_at_fork(after_in_child=_forget)
