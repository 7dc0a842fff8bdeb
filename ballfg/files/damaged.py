"""Bounds the size of damaged or hostile files and turns a library's error into one line.

Every reader calls this room before it decodes anything. A small file may unpack to `FREE` bytes, a large one to `RATIO`
times its size more; text is held whole up to `MAX_TEXT` bytes, an image up to `MAX_PIXELS`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ballfg.checks import one_line, short_text

FREE: Final = 32_000_000  # number of bytes that any file may unpack to
RATIO: Final = 20  # multiple of its own size that it may unpack to beyond that; measurements shrink to a third
NUMBER: Final = 8  # number of bytes of a number in memory, whatever its size in a file
MAX_TEXT: Final = 250_000_000  # largest number of bytes of a text file that is held whole
MAX_LINE: Final = 1 << 18  # Largest number of characters in a line of a table. Lines of results have some 400.
MAX_COLUMNS: Final = 10_000  # Largest number of columns of a table. Marker systems write a few hundred.
MAX_PIXELS: Final = 64_000_000  # of an image or a frame: 192 MB of three colours; a frame in 4K has 8 million
_SAID: Final = 160  # largest number of characters of a library's own words


@contextmanager
def library_reads(path: Path, kind: str, remedy: str = "Copy or export it again.") -> Iterator[None]:
    """Turns any exception of a library at a damaged file into one line with its name. Raises: ValueError."""
    try:
        yield
    except Exception as error:
        if type(error) is ValueError and str(path) in str(error):
            raise
        said = short_text(one_line(error) or type(error).__name__, _SAID)
        raise ValueError(f"{path} must be a whole {kind} file; {said}. {remedy}") from None


def most_unpacked(path: Path, free: int = FREE) -> int:
    """Number of bytes that a file may unpack to."""
    return free + RATIO * path.stat().st_size


def check_unpacked(path: Path, size: int, free: int = FREE) -> None:
    """Refuses a file that claims to hold far more than its own size allows; call it before unpacking.

    Args: path: of the file.  size: bytes that its content would take in memory, `NUMBER` for each cell of a table.
        free: number of bytes that any file may unpack to; fewer for a format with slow readers.
    Raises: ValueError: more than that and 20 times the size of the file.
    """
    most = most_unpacked(path, free)
    if size > most:
        raise ValueError(
            f"{path} must unpack to at most {most / 1e6:.0f} MB, which is {free / 1e6:.0f} MB and {RATIO} times its "
            f"size; it says {short_text(f'{size / 1e6:.0f}')} MB. Write it again without rows that say nothing."
        )


def check_parts(path: Path, what: str, count: int, most: int) -> None:
    """Refuses a file with too many parts for its reader. Args: what: the parts. Raises: ValueError."""
    if count > most:
        raise ValueError(f"{path} must have at most {most} {what}; got {count}. Split it, or leave some out.")


def check_pixels(path: Path, width: int, height: int) -> None:
    """Refuses an image of 0 or over `MAX_PIXELS` px, before it is decoded. Raises: ValueError."""
    if not 0 < width * height <= MAX_PIXELS:
        raise ValueError(
            f"{path} must have at most {MAX_PIXELS / 1e6:g} million pixels; it says {width} x {height}. Scale it down."
        )


def whole_content(path: Path, most: int = MAX_TEXT) -> bytes:
    """The bytes of a file of at most `most`. Raises: ValueError: it is larger, such as a sparse file. OSError."""
    size = path.stat().st_size
    if size > most:
        raise ValueError(f"{path} must have at most {most / 1e6:g} MB; it has {size / 1e6:.0f} MB. Split it.")
    return path.read_bytes()
