"""Starts the installed programs and prepares their process before any large import.

Ctrl-C, SIGTERM and SIGHUP give one line even during those imports.
"""

import atexit
import os
import sys
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from ballfg.interrupts import interrupted, let_go, listen, say_so
from ballfg.machine import collect_rarely, keep_memory


def ballfg() -> None:
    """The program `ballfg`."""
    _run("ballfg.cli.main")


def bench() -> None:
    """The program `ballfg-bench`."""
    _run("ballfg.benchmarks.cli")


def train() -> None:
    """The program `ballfg-train`."""
    _run("ballfg.learning.cli")


def _run(module: str) -> None:
    # threads of the linear algebra wait actively for each other: on a busy machine thirty times as long
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        listen()
        _open_streams()
        _check_folder()
        collect_rarely()
        keep_memory()
        import_module(module).run()
    except KeyboardInterrupt:
        _leave(say_so())
    except SystemExit as end:
        if isinstance(end.code, int):
            _leave(end.code)
        raise
    except Exception:
        if interrupted():  # a library has replaced the interrupt by another exception
            _leave(say_so())
        raise
    finally:
        let_go()


def _leave(status: int) -> NoReturn:
    """Ends the process without Python's shutdown, which takes 0.7 s of a processor for torch and similar packages."""
    let_go()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the reader may be gone
            stream.flush()
    os._exit(status)


def _open_streams() -> None:
    """Redirects streams that the parent process has closed to nowhere.

    Else `print` would fail, and messages for stderr would go to stdout among the data. The next opened file would get a
    stream's number, and a library's prints would go into it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest that is free
        os.set_inheritable(number, True)
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  it stays open


def _check_folder() -> None:
    """Refuses a removed current folder, in which libraries end the process on import with messages of their own."""
    try:
        os.getcwd()
    except OSError as error:
        print(f"ballfg: error: the current folder: {error.strerror}. Go to one that exists.", file=sys.stderr)
        sys.exit(2)
