"""One case in a process of its own, which may take 2 s and 1 GB: read, refused in one line, or a fault."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import select
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

from ballfg.cli.start import USER_ERRORS

SECONDS = 2.0
"""Of the processor, for a case."""
WAITING = 60.0
"""s after which a case that uses no processor counts as hanging."""
MEMORY = 1 << 30
"""Bytes beyond those that the process has before a case."""
LONGEST = 2000
"""Characters of a message that the command line prints whole."""

Case = Callable[[str, str], object]
"""Reads the folder of a reader, by name, in which one file, by its path in there, was damaged."""


def verdict(read: Callable[[], object], names: tuple[str, ...]) -> tuple[str, str]:
    """What becomes of reading: `read`, `refused` or `fault`, and the message.

    Args: read: to call.  names: one of which a message has to hold; none: any message will do.
    """
    try:
        read()
    except USER_ERRORS as error:
        words = str(error)
        if type(error).__name__ == "UndecidedError":  # a question: it names the option that answers it
            names = ()
        if type(error).__name__ == "LinAlgError":
            return "fault", f"numpy's own error: {words}"
        if len(words.splitlines()) != 1:
            return "fault", f"{type(error).__name__} whose message is not one line: {words!r}"
        if len(words) > LONGEST:
            return "fault", f"{type(error).__name__} whose message has {len(words)} characters: {words[:200]!r}"
        if names and not any(name in words for name in names):
            return "fault", f"{type(error).__name__} whose message names no file: {words!r}"
        return "refused", words
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in place if "ballfg" in frame.filename or "learning" in frame.filename] or place
        return "fault", f"{type(error).__name__} in {Path(own[-1].filename).name}:{own[-1].lineno}: {error!s:.300}"
    return "read", ""


def in_a_process(work: Callable[[], object]) -> None:
    """Runs something whose memory and threads must not be there when this process forks. Raises: RuntimeError."""
    child = os.fork()
    if not child:
        status = 1
        try:
            work()
            status = 0
        finally:
            sys.stderr.flush()
            os._exit(status) if status == 0 else None
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("a file could not be written")


class Worker:
    """A process that reads cases one after the other; after a fault that ended it the next case starts another one."""

    def __init__(self, judge: Callable[[str, str], tuple[str, str]], warm: Callable[[], object]) -> None:
        self._judge, self._warm = judge, warm
        self._child = 0
        self._cases = 0
        self._to = self._answers = -1

    def __call__(self, reader: str, file: str) -> tuple[str, str]:
        """What becomes of a case."""
        if self._child and self._cases >= 2000:  # what libraries keep must not add up
            self.close()
        if not self._child:
            self._start()
        self._cases += 1
        os.write(self._to, json.dumps([reader, file]).encode() + b"\n")
        answer = self._answer(WAITING)
        if answer is not None:
            return answer[0], answer[1]
        return "fault", self._end()

    def close(self) -> None:
        """Ends the process."""
        if self._child:
            self._end()

    def _start(self) -> None:
        there, self._to = os.pipe()
        self._answers, here = os.pipe()
        self._child, self._cases = os.fork(), 0
        if not self._child:
            os.close(self._to)
            os.close(self._answers)
            self._serve(there, here)
        os.close(there)
        os.close(here)
        started = self._answer(300.0)  # imports, and one good file for each reader
        if started is None or started[0] != "read":
            raise RuntimeError(f"a good file must be read; {started or self._end()}")

    def _answer(self, seconds: float) -> list[str] | None:
        """A line of the process; None where it ended or says nothing."""
        line, end = b"", time.monotonic() + seconds
        while not line.endswith(b"\n"):
            if not select.select([self._answers], [], [], max(0.0, end - time.monotonic()))[0]:
                return None
            part = os.read(self._answers, 1 << 16)
            if not part:
                return None
            line += part
        found: list[str] = json.loads(line)
        return found

    def _end(self) -> str:
        """How the process ended, which is made to."""
        ended, status = os.waitpid(self._child, os.WNOHANG)
        if not ended:
            time.sleep(0.2)  # it may be on its way down
            ended, status = os.waitpid(self._child, os.WNOHANG)
        if not ended:
            os.kill(self._child, signal.SIGKILL)
            os.waitpid(self._child, 0)
        os.close(self._to)
        os.close(self._answers)
        self._child = 0
        if not ended:
            return f"hang: waits for over {WAITING:g} s"
        if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGPROF:
            return f"hang: over {SECONDS:g} s of the processor"
        return f"crash: {signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else status}"

    def _serve(self, cases: int, answers: int) -> None:
        """The life of the process."""
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        faulthandler.disable()
        warnings.simplefilter("ignore")
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        self._say(answers, verdict(self._warm, ()))
        with os.fdopen(cases, "rb") as lines:
            for line in lines:
                reader, file = json.loads(line)
                resource.setrlimit(resource.RLIMIT_DATA, (_data() + MEMORY, resource.RLIM_INFINITY))
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
                found = self._judge(reader, file)
                signal.setitimer(signal.ITIMER_PROF, 0.0)
                resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
                self._say(answers, found)
        os._exit(0)

    def _say(self, answers: int, found: tuple[str, str]) -> None:
        os.write(answers, json.dumps(found).encode() + b"\n")


def _data() -> int:
    """Bytes of memory that the process has for itself."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData"):
            return 1024 * int(line.split()[1])
    raise OSError("/proc/self/status has no VmData")
