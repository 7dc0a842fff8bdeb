"""Computes chunks for another process, and ends as soon as that one ends."""

import os
import pickle
import signal
import traceback
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, Final

from ballfg.machine import collect_rarely, keep_memory
from ballfg.parallel.work import compute, packed

IDLE: Final = 300.0  # s without work after which a process ends
_asker: Connection | None = None


def serve(handle: int) -> None:
    """Computes one chunk after another, until no more come."""
    global _asker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C at the terminal: the calling process ends this one
    Thread(target=_end_with_asker, daemon=True).start()
    collect_rarely()
    keep_memory()
    _asker = Connection(handle)
    try:
        while _asker.poll(IDLE):
            _send(_answer(*pickle.loads(_asker.recv_bytes())))
    except (EOFError, ConnectionError):
        return


def tell(thing: Any) -> None:
    """Sends an object to the calling process during a chunk; see `Processes.sender`."""
    _send(("told", thing))


def _end_with_asker() -> None:
    """Ends the process when standard input ends, because its only writer has ended."""
    while os.read(0, 1024):
        pass
    os._exit(0)


def _send(thing: tuple[str, Any]) -> None:
    assert _asker is not None
    _asker.send_bytes(pickle.dumps(thing))


def _answer(folder: str, name: str, content: bytes, chunk: bytes | None, versions: dict[str, str]) -> tuple[str, bytes]:
    try:
        os.chdir(folder)  # the calling process may have changed its folder since it started this one
        return "value", compute(name, content, chunk, versions)
    except BaseException as error:
        return "error", _packed(error)


def _packed(error: BaseException) -> bytes:
    """An exception that can be raised elsewhere, with its original traceback as text."""
    lines = "".join(traceback.format_exception(error))
    if not isinstance(error, Exception):  # raised elsewhere it would end more than this work
        error = ChildProcessError(f"work must return or raise; it left by {type(error).__name__}. Mend its code.")
    error.add_note(f"raised in another process:\n{lines}")
    try:
        content = packed(error)
        pickle.loads(content)
    except Exception:  # some cannot be copied
        return packed(RuntimeError(lines))
    return content
