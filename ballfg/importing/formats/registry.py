"""Registers further file formats for imports, of a user or of other installed packages."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Final

from ballfg.registry import Registry


class Format(ABC):
    """A user's file format: a name, the endings of its files, and a reader.

    Attributes:
        name: of the format.
        endings: of its files, with the dot and in small letters, such as `.trk`.
    """

    name: ClassVar[str]
    endings: ClassVar[tuple[str, ...]]

    @staticmethod
    @abstractmethod
    def read(path: Path) -> Any:
        """The content of a file: a mapping of column names to arrays, an array (n, 4), or a list of such parts.

        Times are in s and positions in m, unless column names state a unit.

        Raises: ValueError: if the file cannot be read; the message names it.
        """


FORMATS: Final[Registry[Format]] = Registry(
    "format", group="ballfg.formats", base=Format, remedy="docs/add_an_effect.md has an example."
)
register_format = FORMATS.register
"""Registers a format, so that its files can be imported; may decorate the class."""
