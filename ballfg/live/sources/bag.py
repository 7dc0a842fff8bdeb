"""Reads positions from rosbag2 folders and MCAP files without ROS, once their unpacked size is checked.

It needs the extra `ros`. SQL views in place of tables are refused.
"""

import importlib
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path
from struct import unpack
from typing import IO, Any, Final

import numpy as np

from ballfg.checks import listed
from ballfg.files.damaged import check_unpacked, library_reads
from ballfg.files.strict_yaml import read_mapping
from ballfg.live.mcap import readable
from ballfg.live.sources.sender import Sample

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
                _count(path, _unpacked(file, "zstd"), 0)
        elif path.suffix in ENDINGS:
            _check_file(path, path.suffix, messages=mode == "message")


def _check_file(path: Path, ending: str, messages: bool = False) -> None:
    """Args: messages: True if each message is compressed by itself."""
    with library_reads(path, "bag"):
        size = 0
        for data, compression in _mcap(path) if ending == ".mcap" else _database(path):
            packed = compression or ("zstd" if messages else "")
            size = _count(path, _unpacked(BytesIO(data), packed), size) if packed else size


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


def _unpacked(file: IO[bytes], compression: str) -> Any:
    if compression == "lz4":
        return importlib.import_module("lz4.frame").open(file)
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name).open(file)
        except ImportError:
            continue
    return importlib.import_module("zstandard").ZstdDecompressor().stream_reader(file)


Point = Any
Reading = tuple[Sequence[Point], Any]  # The points of a message, and the covariance (36,) of a single one or None

READERS: dict[str, Callable[[Any], Reading]] = {
    "geometry_msgs/msg/PointStamped": lambda m: ([m.point], None),
    "geometry_msgs/msg/PoseStamped": lambda m: ([m.pose.position], None),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: ([m.pose.pose.position], m.pose.covariance),
    "geometry_msgs/msg/PoseArray": lambda m: ([pose.position for pose in m.poses], None),
    "geometry_msgs/msg/TransformStamped": lambda m: ([m.transform.translation], None),
    "nav_msgs/msg/Odometry": lambda m: ([m.pose.pose.position], m.pose.covariance),
}
"""Reader of positions for each type of message."""


def need_rosbags() -> None:
    """Raises ValueError without the extra."""
    try:
        import rosbags  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"bags must be read and written by the package rosbags; got {error}. Install it: pip install 'ballfg[ros]'."
        ) from None


def bag_samples(bag: Path, topic: str | None) -> Iterator[Sample]:
    """The positions of a topic, with the stamps of their headers.

    Args: bag: a folder of rosbag2, or a file .mcap or .db3.  topic: None takes the only one with positions.
    Raises: ValueError: no such topic, or the package `rosbags` is missing. FileNotFoundError: no such bag.
    """
    need_rosbags()
    if not bag.exists():
        raise FileNotFoundError(f"bag must exist; {bag} does not. Give a folder of rosbag2 or a file .mcap.")
    check_bag(bag)
    chosen = _topic(bag, topic)
    return _samples(bag, chosen)


def _opened(bag: Path) -> Any:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path = readable(bag) if bag.suffix == ".mcap" else bag
    return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _topic(bag: Path, topic: str | None) -> str:
    """The topic to read. Raises: ValueError: no such topic."""
    with library_reads(bag, "bag"), _opened(bag) as reader:
        kinds = {connection.topic: str(connection.msgtype) for connection in reader.connections}
    good = [name for name, kind in kinds.items() if kind in READERS]
    held = listed([f"{name} ({kind})" for name, kind in kinds.items()])
    if topic is None and len(good) == 1:
        return good[0]
    if topic is None or topic not in good:
        known = ", ".join(kind.rpartition("/")[2] for kind in READERS)
        got = f"{topic!r}" if topic is not None else "none"
        raise ValueError(f"topic must be one of {known}; got {got}. {bag} has: {held}. Choose with --topic.")
    return topic


def _samples(bag: Path, topic: str) -> Iterator[Sample]:
    with library_reads(bag, "bag"), _opened(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            points, covariance = READERS[connection.msgtype](message)
            if len(points):
                positions = [[float(p.x), float(p.y), float(p.z)] for p in points]
                yield Sample(stamp.sec + 1e-9 * stamp.nanosec, positions, _sigmas(covariance))


def _sigmas(covariance: Any) -> list[list[float]] | None:
    """m, from the covariance (36,) of a pose; None without one."""
    if covariance is None:
        return None
    variances = np.asarray(covariance, dtype=np.float64).reshape(6, 6).diagonal()[:3]
    return [np.sqrt(variances).tolist()] if (np.isfinite(variances) & (variances > 0.0)).all() else None
