"""Checks the unpacked size of a bag before it is opened, and refuses SQL views in place of tables."""

import importlib
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from struct import unpack
from typing import IO, Any, Final

from ballfg.files.damaged import check_unpacked, library_reads
from ballfg.files.strict_yaml import read_mapping

ENDINGS: Final = (".mcap", ".db3")
METADATA: Final = "metadata.yaml"
_CHUNK: Final = 6  # Opcode of a chunk in MCAP, the only record that is compressed
_BLOCK: Final = 1 << 20
_GENERATED: Final = 2  # Value of sqlite's `table_xinfo` from which a column is computed


def check_bag(bag: Path) -> None:
    """Refuses a bag that holds far more than its size allows, or computed content.

    Args: bag: a folder of rosbag2, or a file .mcap or .db3.
    Raises: ValueError: with the name of the file.
    """
    if not bag.is_dir():
        if bag.suffix in ENDINGS:  # the reader refuses others
            _check_file(bag, bag.suffix)
        return
    if not (bag / METADATA).is_file():
        return  # the reader reports the missing file
    about = read_mapping(bag / METADATA).get("rosbag2_bagfile_information")
    mode = str(about.get("compression_mode", "")).lower() if isinstance(about, dict) else ""
    for path in sorted(bag.iterdir()):
        if mode == "file" and path.suffix == ".zstd":
            with path.open("rb") as file:
                _count(path, _opened(file, "zstd"), 0)
        elif path.suffix in ENDINGS:
            _check_file(path, path.suffix, messages=mode == "message")


def _check_file(path: Path, ending: str, messages: bool = False) -> None:
    """Args: messages: True if each message is compressed by itself."""
    with library_reads(path, "bag"):
        size = 0
        for data, compression in _mcap(path) if ending == ".mcap" else _database(path):
            packed = compression or ("zstd" if messages else "")
            size = _count(path, _opened(BytesIO(data), packed), size) if packed else size


def _mcap(path: Path) -> Iterator[tuple[bytes, str]]:
    with path.open("rb") as file:
        end = file.seek(0, 2)
        file.seek(8)
        while file.tell() < end and len(head := file.read(9)) == 9:
            code, length = unpack("<BQ", head)
            start = file.tell()
            if code == _CHUNK:
                _, _, size, _, letters = unpack("<QQQII", file.read(32))
                check_unpacked(path, size)
                compression = file.read(letters).decode("ascii")
                (packed,) = unpack("<Q", file.read(8))
                yield (file.read(packed), compression) if compression else (b"", "")
            file.seek(start + length)


def _database(path: Path) -> Iterator[tuple[bytes, str]]:
    """The data of each message, whose compression no table states.

    Raises: ValueError: a view, a virtual table or a computed column, which may take any time and room.
    """
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        for kind, name, sql in base.execute("SELECT type, name, sql FROM sqlite_master"):
            virtual = str(sql).upper().startswith("CREATE VIRTUAL")
            columns = [] if virtual else base.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
            if kind not in ("table", "index") or virtual or any(hidden >= _GENERATED for (hidden,) in columns):
                raise ValueError(f"{path} must hold plain tables; got a {kind} that computes. Record it again.")
        for (data,) in base.execute("SELECT data FROM messages"):
            yield data, ""


def _count(path: Path, stream: Any, size: int) -> int:
    """Adds up the bytes of a stream. Raises: ValueError: more than the file may unpack to."""
    while block := stream.read(_BLOCK):
        size += len(block)
        check_unpacked(path, size)
    return size


def _opened(file: IO[bytes], compression: str) -> Any:
    """The content of a compressed file, as a stream."""
    if compression == "lz4":
        return importlib.import_module("lz4.frame").open(file)
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name).open(file)
        except ImportError:
            continue
    return importlib.import_module("zstandard").ZstdDecompressor().stream_reader(file)
