"""The entry points of the installed programs: what they need of their process, before anything large is imported.

Ctrl-C, SIGTERM and SIGHUP are one line even while they are being imported.
"""

import atexit
import os
import sys
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from ballfg.collector import collect_rarely
from ballfg.interrupts import interrupted, let_go, listen, say_so


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
    try:
        listen()
        _open_streams()
        _check_folder()
        collect_rarely()
        import_module(module).run()
    except KeyboardInterrupt:
        _leave(say_so())
    except SystemExit as end:
        if interrupted() and isinstance(end.code, int):
            _leave(end.code)
        raise
    except Exception:
        if interrupted():  # a library has made another exception of the interrupt
            _leave(say_so())
        raise
    finally:
        let_go()


def _leave(status: int) -> NoReturn:
    """Ends the process without what Python does at its end: to take torch and its like apart takes half a second."""
    let_go()
    atexit._run_exitfuncs()
    with suppress(OSError):  # whoever reads it may be gone
        sys.stdout.flush()
    os._exit(status)


def _open_streams() -> None:
    """Let streams that whoever started the process has closed lead nowhere.

    Else `print` would find none, messages for stderr would go to stdout, among the data, and the next file to be opened
    would take the number of one, so that what a library prints would go into it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest that is free
        os.set_inheritable(number, True)
    os.close(number)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  it stays open


def _check_folder() -> None:
    """Where the current folder has been removed, libraries end the process on import, with words of their own."""
    try:
        os.getcwd()
    except OSError as error:
        print(f"ballfg: error: the current folder: {error.strerror}. Go to one that exists.", file=sys.stderr)
        sys.exit(2)
