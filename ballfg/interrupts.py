"""Ctrl-C, SIGTERM and SIGHUP: a program ends the same way for each, cleaned up and with one line.

Each raises KeyboardInterrupt in the main thread, at the next step of Python's interpreter: a call into machine code,
such as a compilation, ends first.
"""

import signal
import sys
import time
from contextlib import suppress
from types import FrameType
from typing import Any, Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ONCE: Final = 5.0
"""s after a signal in which others change nothing: terminals and services send several, and none may cut cleaning up
short."""
AGAIN: Final = 0.02
"""s after which an interrupt that Python could not raise comes again."""

_listening: bool = False
_number: int | None = None
_raised: float | None = None


def listen() -> None:
    """Lets the signals end this program."""
    global _listening
    _listening = True
    for number in heeded():
        signal.signal(number, _on_signal)
    signal.signal(signal.SIGALRM, _on_alarm)
    sys.unraisablehook = _not_raised


def heeded() -> list[signal.Signals]:
    """The signals, but for those that whoever started this program wants ignored, as nohup does."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def let_go() -> None:
    """Lets the signals end this process without a word: nothing is left to be cleaned up."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in SIGNALS:
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, signal.SIG_DFL)


def interrupted() -> bool:
    """Whether a signal has asked this program to end."""
    return _number is not None


def is_interrupt(error: BaseException) -> bool:
    """Whether an exception is a signal's, not one that some code has raised by itself."""
    return isinstance(error, KeyboardInterrupt) and (interrupted() or not _listening)


def say_so() -> int:
    """Prints the line about a program that was interrupted. Returns: its exit status, 128 and the signal's number."""
    number = signal.SIGINT if _number is None else signal.Signals(_number)
    by = "" if number == signal.SIGINT else f" by {number.name}"
    with suppress(OSError):  # the terminal may be gone: that is what SIGHUP says
        print(f"ballfg: interrupted{by}", file=sys.stderr)
    return 128 + number


def _on_signal(number: int, _frame: FrameType | None) -> None:
    global _number, _raised
    now = time.monotonic()
    if _raised is not None and now - _raised < ONCE:
        return
    _number, _raised = _number or number, now
    raise KeyboardInterrupt


def _on_alarm(_alarm: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _not_raised(found: Any) -> None:
    """Where Python cannot raise an interrupt, as while it removes an object, it comes again."""
    if isinstance(found.exc_value, KeyboardInterrupt) and interrupted():
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    else:
        sys.__unraisablehook__(found)
