"""Ends a program at Ctrl-C, SIGTERM or SIGHUP in the same way: cleaned up, and with one line.

Each raises KeyboardInterrupt in the main thread, at the next step of Python's interpreter: a call into machine code,
such as a compilation, is finished first.
"""

import signal
import sys
import time
from contextlib import suppress
from types import FrameType
from typing import Any, Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ONCE: Final = 5.0
"""s after a signal during which further ones have no effect: terminals and services send several, and none may
interrupt cleaning up."""
AGAIN: Final = 0.02  # s after which an interrupt that Python could not raise is repeated

_listening: bool = False
_number: int | None = None
_raised: float | None = None


def listen() -> None:
    """Makes the signals end this program."""
    global _listening
    _listening = True
    for number in heeded():
        signal.signal(number, _on_signal)
    signal.signal(signal.SIGALRM, _on_alarm)
    sys.unraisablehook = _not_raised


def heeded() -> list[signal.Signals]:
    """The signals, except for those that the parent process wants ignored, as nohup does."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def let_go() -> None:
    """Makes the signals end this process silently: there is nothing to clean up."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    for number in SIGNALS:
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, signal.SIG_DFL)


def interrupted() -> bool:
    """True if a signal has asked this program to end."""
    return _number is not None


def is_interrupt(error: BaseException) -> bool:
    """True if an exception comes from a signal, not from other code."""
    return isinstance(error, KeyboardInterrupt) and (interrupted() or not _listening)


def say_so() -> int:
    """Prints the line on the interruption. Returns: the exit status, 128 and the signal's number."""
    number = signal.SIGINT if _number is None else signal.Signals(_number)
    by = "" if number == signal.SIGINT else f" by {number.name}"
    with suppress(OSError):  # the terminal may be gone: SIGHUP means that
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
    """Repeats an interrupt that Python could not raise, as during the removal of an object."""
    if isinstance(found.exc_value, KeyboardInterrupt) and interrupted():
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    else:
        sys.__unraisablehook__(found)
