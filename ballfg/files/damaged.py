"""Files that may be damaged or hostile: what a library raises becomes one line, and what they unpack to is bounded."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ballfg.checks import one_line, short_text

FREE: Final = 64_000_000
"""Bytes that any file may unpack to."""
RATIO: Final = 100
"""Times its own size that a file may unpack to beyond that. Measurements shrink to a half or a third."""
_SAID: Final = 160
"""Characters of a library's own words."""


@contextmanager
def library_reads(path: Path, kind: str, remedy: str = "Copy or export it again.") -> Iterator[None]:
    """Turns what a library raises at a damaged file, of whatever class, into one line that names the file.

    Args: path: of the file.  kind: what it must be.  remedy: last sentence of the message.
    Raises: ValueError: any of it; one that names the file already, as it is.
    """
    try:
        yield
    except Exception as error:
        if type(error) is ValueError and str(path) in str(error):
            raise
        said = one_line(error) or type(error).__name__
        said = said if len(said) <= _SAID else f"{said[:_SAID]}..."
        raise ValueError(f"{path} must be a whole {kind} file; {said}. {remedy}") from None


def most_unpacked(path: Path) -> int:
    """Bytes that a file may unpack to."""
    return FREE + RATIO * path.stat().st_size


def check_unpacked(path: Path, size: int) -> None:
    """Refuses a file that says it holds far more than its own size can tell; call it before anything is unpacked.

    Args: path: of the file.  size: bytes that its content would take in memory.
    Raises: ValueError: more than 64 MB and 100 times the size of the file.
    """
    most = most_unpacked(path)
    if size > most:
        raise ValueError(
            f"{path} must unpack to at most {most / 1e6:.0f} MB, which is {FREE / 1e6:.0f} MB and {RATIO} times its "
            f"size; it says {short_text(f'{size / 1e6:.0f}')} MB. Write it again without rows that say nothing."
        )
