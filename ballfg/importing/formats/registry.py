"""File formats that are imported beside those of the package: of a user, or of other installed packages."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Final

from ballfg.registry import Registry


class Format(ABC):
    """A file format of one's own: a name, the endings of its files, and a reader.

    Attributes:
        name: of the format.
        endings: of its files, with the dot and in small letters, such as `.trk`.
    """

    name: ClassVar[str]
    endings: ClassVar[tuple[str, ...]]

    @staticmethod
    @abstractmethod
    def read(path: Path) -> Any:
        """What a file holds: a mapping of column names to arrays, an array (n, 4), or a list of such parts.

        Times are in s and positions in m where the names of columns state no unit.

        Raises: ValueError: if the file cannot be read; the message names it.
        """


FORMATS: Final[Registry[Format]] = Registry(
    "format", group="ballfg.formats", base=Format, remedy="docs/add_an_effect.md has an example."
)
register_format = FORMATS.register
"""Lets files of a format be imported; may decorate the class."""
