"""Bombs in images, videos, bags, archives and files of OpenCV."""

from __future__ import annotations

import gzip
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import cv2
import numpy as np

from tests.faults.bombs_of_arrays import Bomb, Write

SIDE = 20_000
"""px."""


def _image(side: int, kind: type = np.uint8) -> Write:
    """A black image as OpenCV writes it in the format of the file's ending."""
    return lambda path: path.write_bytes(cv2.imencode(path.suffix, np.zeros((side, side), kind))[1].tobytes())


def _bmp(path: Path) -> None:
    """A header without pixels."""
    path.write_bytes(b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 30_000, 30_000, 1, 24, 0, 0, 0, 0, 0, 0))


def _netpbm(path: Path) -> None:
    path.write_bytes(b"P6\n30000 30000\n255\n" + bytes(1000))


def _tiles(path: Path) -> None:
    """A small TIFF that is kept in one huge tile."""
    tags = [
        (256, 64),
        (257, 64),
        (258, 8),
        (259, 1),
        (262, 1),
        (277, 1),
        (322, 32_768),
        (323, 32_768),
        (324, 200),
        (325, 4096),
    ]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + bytes(5000))


def avi(path: Path, frames: list[bytes], width: int, height: int) -> None:
    """A video whose frames are pictures. Args: width, height: as its header says them, px."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    main = struct.pack("<14I", 20_000, 0, 0, 16, len(frames), 0, 1, 0, width, height, 0, 0, 0, 0)
    stream = b"vidsMJPG" + struct.pack("<10I4H", 0, 0, 0, 1, 50, 0, len(frames), 0, 0xFFFFFFFF, 0, 0, 0, 0, 0)
    form = struct.pack("<IiiHH4sIIIII", 40, width, height, 1, 24, b"MJPG", 0, 0, 0, 0, 0)
    headers = chunk(b"avih", main) + chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", form))
    body = chunk(b"LIST", b"hdrl" + headers) + chunk(b"LIST", b"movi" + b"".join(chunk(b"00dc", one) for one in frames))
    path.write_bytes(b"RIFF" + struct.pack("<I", 4 + len(body)) + b"AVI " + body)


def _video(width: int, height: int) -> Write:
    """Frames of 14,000 by 14,000 px, whatever the header says."""

    def write(path: Path) -> None:
        avi(path, [cv2.imencode(".jpg", np.zeros((14_000, 14_000), np.uint8))[1].tobytes()] * 3, width, height)

    return write


def _record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def _string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def mcap(compression: str, says: int | None = None, size: int = 1_000_000_000) -> Write:
    """A bag with one chunk of zeros.

    Args: says: bytes of it, where that is another number.  size: bytes.
    """

    def write(path: Path) -> None:
        from lz4.frame import compress as lz4

        raw = bytes(size)
        if compression == "zstd":
            from backports import zstd

            packed = zstd.compress(raw)
        else:
            packed = lz4(raw)
        chunk = (
            struct.pack("<QQQI", 0, 1, size if says is None else says, 0)
            + _string(compression)
            + struct.pack("<Q", len(packed))
            + packed
        )
        head, magic = _record(1, _string("ros2") + _string("made")), b"\x89MCAP0\r\n"
        path.write_bytes(magic + head + _record(6, chunk) + _record(2, bytes(20)) + magic)

    return write


_TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
    "offered_qos_profiles TEXT); INSERT INTO topics VALUES (1, '/b', 'geometry_msgs/msg/PointStamped', 'cdr', '');"
)
_ROWS = "(WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 1000000000) SELECT i FROM n)"


def _database(sql: str) -> Write:
    def write(path: Path) -> None:
        with closing(sqlite3.connect(path)) as base:
            base.executescript(_TABLES + sql)

    return write


def _packed_bag(path: Path) -> None:
    """A folder of rosbag2 whose only file is compressed."""
    from backports import zstd

    path.write_bytes(zstd.compress(bytes(1_000_000_000)))
    (path.parent / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {version: 5, storage_identifier: sqlite3, duration: {nanoseconds: 1}, "
        "starting_time: {nanoseconds_since_epoch: 0}, message_count: 1, compression_format: zstd, "
        f"compression_mode: FILE, topics_with_message_count: [], relative_file_paths: [{path.name}]}}\n"
    )


def _zip_of_text(path: Path) -> None:
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        archive.writestr("tracks.csv", "1,2,3,4\n" * 50_000_000)


def _gz(path: Path) -> None:
    path.write_bytes(gzip.compress(b"t,x,y,z\n" + b"1,2,3,4\n" * 30_000_000, 1))


def _storage(text: str, count: int) -> Write:
    return lambda path: path.write_text(f"<?xml version='1.0'?>\n<opencv_storage>{text * count}</opencv_storage>")


OTHERS: dict[str, Bomb] = {
    "png/20,000 by 20,000": ("boards", "x.png", _image(SIDE)),
    "png/of a video": ("video", "images/0.png", _image(SIDE)),
    "png/16 bits": ("boards", "x.png", _image(SIDE // 2, np.uint16)),
    "jpeg/30,000 by 30,000": ("boards", "x.jpg", _image(30_000)),
    "jpeg/of a video": ("video", "images/2.jpg", _image(30_000)),
    "tiff/20,000 by 20,000": ("boards", "x.tif", _image(SIDE)),
    "tiff/one huge tile": ("boards", "x.tif", _tiles),
    "bmp/a header alone": ("boards", "x.bmp", _bmp),
    "webp/16,383 by 16,383": ("boards", "x.webp", _image(16_383)),
    "ppm/a header alone": ("boards", "x.ppm", _netpbm),
    "avi/14,000 by 14,000": ("video", "a.avi", _video(14_000, 14_000)),
    "avi/a header that says less": ("video", "a.avi", _video(48, 32)),
    "mcap/zstd": ("import", "x.mcap", mcap("zstd")),
    "mcap/lz4": ("import", "x.mcap", mcap("lz4")),
    "mcap/a size that is none": ("import", "x.mcap", mcap("zstd", 100)),
    "db3/a view": ("import", "x.db3", _database(
        f"CREATE VIEW messages AS SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM {_ROWS}"
    )),
    "db3/a view beside tables": ("import", "x.db3", _database(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        f"CREATE VIEW schema AS SELECT max(i) AS schema_version FROM {_ROWS};"
    )),
    "db3/a computed column": ("import", "x.db3", _database(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);"
        "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1), (1, 2), (1, 3);"
    )),
    "zstd/a file of a bag": ("import", "bag/x.db3.zstd", _packed_bag),
    "zip/text": ("import", "x.zip", _zip_of_text),
    "gz/text": ("import", "x.csv.gz", _gz),
    "opencv/numbers": ("cameras", "cameras.xml", _storage("<a>" + "0 " * 8_000_000 + "</a>", 1)),
    "opencv/nodes": ("cameras", "cameras.xml", _storage("<a/>", 4_000_000)),
    "opencv/nested": ("cameras", "cameras.xml", _storage("<a>", 900_000)),
    "opencv/values": ("cameras", "cameras.json", lambda path: path.write_text('{"a": [' + "0," * 450_000 + "0]}")),
}  # fmt: skip
