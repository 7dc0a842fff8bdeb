"""Turns the files, folders or data of a user into tables, of formats that others register too."""

import json
import zipfile
from abc import ABC, abstractmethod
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Final

from ballfg.checks import check_path, listed, shown
from ballfg.files.json_file import TOO_MANY, has_too_many, parse_json
from ballfg.importing.formats.containers import read_bag, read_excel, read_hdf5, read_matlab, read_npz, read_parquet
from ballfg.importing.formats.nested import nested_tables
from ballfg.importing.formats.raw import RawTable
from ballfg.importing.formats.text_files import decoded, text_table
from ballfg.registry import Registry
from ballfg.tracks.info import INFO_FILE


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


TEXT: Final = (".csv", ".tsv", ".txt", ".dat", ".tab", ".asc", "")
JSON: Final = (".json", ".jsonl", ".ndjson")
BAGS: Final = (".mcap", ".db3")
READERS: Final = {
    ".parquet": read_parquet, ".pq": read_parquet, ".xlsx": read_excel, ".xlsm": read_excel, ".npz": read_npz,
    ".npy": read_npz, ".h5": read_hdf5, ".hdf5": read_hdf5, ".hdf": read_hdf5, ".mat": read_matlab,
}  # fmt: skip
_MAGIC: Final = (
    (b"PAR1", read_parquet), (b"\x89HDF", read_hdf5), (b"\x93NUMPY", read_npz), (b"MATLAB 5.0", read_matlab),
)  # fmt: skip
_OWN: Final = ("import.html", "truth.csv", "truth.parquet")  # files in a dataset's folder that hold no measurements


def tables_of(data: Any, topic: str | None = None, key: str | None = None) -> list[RawTable]:
    """All tables of a source.

    Args: data: a path or several, of files and folders; a DataFrame, a dict of arrays, an array, or a list of these.
        topic: of a ROS bag.  key: part of the names of the wanted tables.
    Raises: FileNotFoundError: no such path. ValueError: unreadable, or no table of that key.
    """
    if isinstance(data, str | PathLike):
        data = [data]
    if isinstance(data, list | tuple) and data and all(isinstance(one, str | PathLike) for one in data):
        found = [table for path in data for table in _of_path(check_path("source", path), topic)]
        name = ", ".join(str(path) for path in data)
    else:
        found, name = nested_tables(data, "", "data"), "data"
    if not found:
        problem = f"{name} must hold a table with a time and x, y, z; none was found"
        raise ValueError(f"{problem}. Give (n, 4) numbers t, x, y, z, or columns of these names.")
    if key is None:
        return found
    chosen = [table for table in found if table.name == key or Path(table.source).name == key] or [
        table for table in found if key in f"{table.source}/{table.name}"
    ]
    if not chosen:
        names = listed(dict.fromkeys(table.name or table.source for table in found))
        raise ValueError(f"--key must name a table of the source; got {shown(key)}, there are {names}.")
    return chosen


def _of_path(path: Path, topic: str | None) -> list[RawTable]:
    if not path.exists():
        raise FileNotFoundError(f"source must exist; {path} does not. Give a file or a folder.")
    if path.is_file():
        return _of_file(path, topic)
    if not path.is_dir():
        raise ValueError(f"source must be a file or folder; {path} is a pipe or a device. Write what comes to a file.")
    if (path / "metadata.yaml").is_file() or any(path.glob("*.db3")):
        return read_bag(path, topic)
    known = (*TEXT[:-1], *JSON, *BAGS, *READERS, *_added())
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.suffix.lower() in known]
    files = [file for file in files if not file.name.startswith(".") and file.name not in _OWN]
    files = [file for file in files if "readme" not in file.name.lower()]
    made = {info.parent for info in path.rglob(INFO_FILE)} - {path}  # datasets, such as an earlier import's result
    files = [file for file in files if made.isdisjoint(file.parents)]
    if not files:
        listing = listed(sorted(entry.name for entry in path.iterdir()))
        raise ValueError(f"{path} must hold files of measurements, such as .csv or .json; got {listing}. Name another.")
    return [table for file in files for table in _of_file(file, topic)]


def _added() -> dict[str, type[Format]]:
    return {ending: added for added in FORMATS.values() for ending in added.endings}


def _of_file(path: Path, topic: str | None) -> list[RawTable]:
    ending = path.suffix.lower()
    if path.stat().st_size == 0:
        raise ValueError(f"{path} must hold rows of numbers; the file is empty. Export it again.")
    if added := _added().get(ending):
        return nested_tables(added.read(path), path.stem, str(path))
    if ending in BAGS:
        return read_bag(path, topic)
    if ending in READERS:
        return READERS[ending](path)
    with path.open("rb") as file:
        head = file.read(16)
    for magic, reader in _MAGIC:
        if head.startswith(magic):
            return reader(path)
    if zipfile.is_zipfile(path):  # an npz or xlsx file whose name has another ending
        with zipfile.ZipFile(path) as archive:
            arrays = any(name.endswith(".npy") for name in archive.namelist())
        return read_npz(path) if arrays else read_excel(path)
    text = decoded(path) if ending in JSON or head.lstrip(b"\xef\xbb\xbf \r\n\t")[:1] in (b"{", b"[") else None
    return [text_table(decoded(path), path.stem, str(path))] if text is None else _json(path, text)


def _json(path: Path, text: str) -> list[RawTable]:
    """The tables of a JSON file, or of one with a JSON value on each line."""
    if has_too_many(text):
        raise ValueError(f"{path} is too large for JSON: {TOO_MANY}. Split it, or write CSV or Parquet.")
    try:
        content = parse_json(text)
    except json.JSONDecodeError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        try:
            parse_json(lines[0])
        except json.JSONDecodeError:
            raise ValueError(
                f"{path}, line {error.lineno}: must be valid JSON; {error.msg} at column {error.colno}, as in a file "
                "that was cut off. Write it again, whole."
            ) from None
        content = []
        for number, line in enumerate(lines, 1):
            try:
                content.append(parse_json(line))
            except json.JSONDecodeError as wrong:
                problem = f"{path}, line {number}: must be valid JSON; {wrong.msg} at column {wrong.colno}"
                raise ValueError(f"{problem}. Correct or delete the line.") from None
    if isinstance(content, dict) and not any(isinstance(value, list | dict) for value in content.values()):
        content = [content]
    return nested_tables(content, path.stem, str(path))
