"""Writes MCAP files that grow by whole chunks, so that a killed writer's file can be read and continued.

Source: the MCAP format specification, version 0 (mcap.dev/spec). A file opens with schemas and channels. Chunks follow,
each with an index of its messages for every channel. A summary ends the file: readers require it, though the chunks
contain the same information.
"""

import io
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PosixPath
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import Any, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
STATISTICS, DATA_END = 11, 15
RECORD = struct.Struct("<BQ")  # Header of each record: its kind and its number of bytes
SPAN = struct.Struct("<QQQIIQ")
"""Header of a chunk: first and last time (ns), bytes of the content, checksum (0: none), length of the name of the
compression (0: none), bytes of the content again."""
INDEX = struct.Struct("<HI")  # Header of an index: channel, bytes of the entries
ENTRY = struct.Struct("<QQ")  # Entry of an index: time of a message (ns) and its offset in the chunk
WRITER = "ballfg"
LONGEST_OPENING = 1 << 20  # Largest number of bytes of an opening; that of the two topics of `ballfg live` has 4,000

Read = Callable[[int, int], bytes]  # Function that reads bytes of a file from an offset on, at most a given number


class Message(NamedTuple):
    """A message of a channel, numbered from 1, at a time in ns."""

    channel: int
    time: int
    data: bytes


@dataclass(frozen=True)
class Chunk:
    """Place of a chunk in the file.

    Attributes:
        first, last: ns, times of its messages.  offset: bytes, of its record.  content: bytes of its messages.
        counts: messages of each channel.
    """

    first: int
    last: int
    offset: int
    content: int
    counts: tuple[int, ...]

    @property
    def indexes(self) -> tuple[int, ...]:
        """Offsets of the index of each channel, and of the end of the last."""
        found = [self.offset + RECORD.size + SPAN.size + self.content]
        for count in self.counts:
            found.append(found[-1] + RECORD.size + INDEX.size + ENTRY.size * count)
        return tuple(found)

    @property
    def end(self) -> int:
        """Offset of the end of the chunk and its indexes."""
        return self.indexes[-1]


def opening(topics: Sequence[tuple[str, str, str]]) -> bytes:
    """The opening of a file: its header, then the schema and the channel of each topic, numbered from 1.

    Args: topics: name of each, with the name and the definition of its messages in ROS 2.
    """
    parts = [MAGIC, _record(HEADER, _text("ros2") + _text(WRITER))]
    for number, (name, kind, definition) in enumerate(topics, start=1):
        schema = _text(kind) + _text("ros2msg") + _text(definition)
        metadata = _text("offered_qos_profiles") + _text("[]")
        channel = _text(name) + _text("cdr") + struct.pack("<I", len(metadata)) + metadata
        parts.append(_record(SCHEMA, struct.pack("<H", number) + schema))
        parts.append(_record(CHANNEL, struct.pack("<HH", number, number) + channel))
    return b"".join(parts)


def chunk_of(messages: Sequence[Message], channels: int, offset: int) -> tuple[bytes, Chunk]:
    """A chunk and its indexes as bytes, and its place.

    Args: messages: at least one.  channels: their number.  offset: bytes, of the chunk in the file.
    """
    content = bytearray()
    entries = [bytearray() for _ in range(channels)]
    for message in messages:
        entries[message.channel - 1] += ENTRY.pack(message.time, len(content))
        head = struct.pack("<HIQQ", message.channel, 0, message.time, message.time)
        content += _record(MESSAGE, head + message.data)
    times = [message.time for message in messages]
    counts = tuple(len(own) // ENTRY.size for own in entries)
    chunk = Chunk(min(times), max(times), offset, len(content), counts)
    parts = [_record(CHUNK, SPAN.pack(chunk.first, chunk.last, len(content), 0, 0, len(content)) + content)]
    parts += [_record(MESSAGE_INDEX, INDEX.pack(n, len(own)) + own) for n, own in enumerate(entries, start=1)]
    return b"".join(parts), chunk


def whole_chunks(read: Read, begin: int, size: int, channels: int) -> list[Chunk]:
    """The whole chunks of a file, with their indexes, up to its ending or to a chunk that is cut off.

    Args: begin: bytes of the opening.  size: bytes of the file.  channels: their number.
    Raises: ValueError: another record among them.
    """
    found: list[Chunk] = []
    while (chunk := _chunk_at(read, found[-1].end if found else begin, channels)) is not None and chunk.end <= size:
        found.append(chunk)
    return found


def ending(begin: bytes, chunks: Sequence[Chunk], channels: int) -> bytes:
    """The ending of a file, after its last chunk.

    Args: begin: the opening.  chunks: all of the file.  channels: their number.
    """
    end = _record(DATA_END, struct.pack("<I", 0))
    offset = (chunks[-1].end if chunks else len(begin)) + len(end)
    counts = [sum(chunk.counts[k] for chunk in chunks) for k in range(channels)]
    first, last = min((c.first for c in chunks), default=0), max((c.last for c in chunks), default=0)
    totals = struct.pack("<QHIIIIQQ", sum(counts), channels, channels, 0, 0, len(chunks), first, last)
    each = b"".join(struct.pack("<HQ", number, count) for number, count in enumerate(counts, start=1))
    declared = begin[len(opening(())) :]  # schemas and channels again
    parts = [end, declared]
    for chunk in chunks:
        places = b"".join(struct.pack("<HQ", n, place) for n, place in enumerate(chunk.indexes[:-1], start=1))
        begun = chunk.indexes[0]
        head = struct.pack("<QQQQI", chunk.first, chunk.last, chunk.offset, begun - chunk.offset, len(places))
        tail = struct.pack("<QIQQ", chunk.end - begun, 0, chunk.content, chunk.content)
        parts.append(_record(CHUNK_INDEX, head + places + tail))
    parts.append(_record(STATISTICS, totals + struct.pack("<I", len(each)) + each))
    return b"".join([*parts, _record(FOOTER, struct.pack("<QQI", offset, 0, 0)), MAGIC])


def readable(path: Path) -> Path:
    """A path for readers: for the file of a killed `ballfg live`, one that adds the missing end.

    The file itself does not change.

    Raises: ValueError: such a file with another record among the chunks.
    """
    with path.open("rb") as file:

        def read(offset: int, count: int) -> bytes:
            file.seek(offset)
            return file.read(count)

        size = file.seek(0, io.SEEK_END)
        if read(max(0, size - len(MAGIC)), len(MAGIC)) == MAGIC and size > len(MAGIC):
            return path
        found = _opening_of(read)
        if found is None:
            return path
        begin, channels = found
        chunks = whole_chunks(read, len(begin), size, channels)
    unfinished = Unfinished(path)
    unfinished.whole = chunks[-1].end if chunks else len(begin)
    unfinished.ending = ending(begin, chunks, channels)
    return unfinished


class Unfinished(PosixPath):
    """A path to a file without end: its reader gets a copy of its whole chunks, and the missing end.

    Attributes: whole: number of valid bytes of the file.  ending: bytes after them.
    """

    whole: int
    ending: bytes

    def open(self, *_: Any, **__: Any) -> Any:
        """The file in binary mode, for reading."""
        copy = TemporaryFile()  # noqa: SIM115 - who opened the path closes it
        with super().open("rb") as file:
            copyfileobj(file, copy)
        copy.truncate(self.whole)
        copy.seek(self.whole)
        copy.write(self.ending)
        copy.seek(0)
        return copy


def _opening_of(read: Read) -> tuple[bytes, int] | None:
    """The opening of a file of `ballfg live`, and the number of its channels; None of another file."""
    content = read(0, LONGEST_OPENING)
    end, channels = len(opening(())), 0
    if not content.startswith(opening(())):
        return None
    while len(content) >= end + RECORD.size:
        kind, length = RECORD.unpack_from(content, end)
        if kind not in (SCHEMA, CHANNEL) or end + RECORD.size + length > len(content):
            break
        end += RECORD.size + length
        channels += kind == CHANNEL
    return content[:end], channels


def _chunk_at(read: Read, offset: int, channels: int) -> Chunk | None:
    """The chunk at an offset; None if the file ends before its indexes do, or at the ending."""
    head = read(offset, RECORD.size + SPAN.size)
    if head[:1] in (b"", bytes([DATA_END])) or (head[0] == CHUNK and len(head) < RECORD.size + SPAN.size):
        return None
    head = head.ljust(RECORD.size + SPAN.size)
    kind, length = RECORD.unpack_from(head)
    first, last, content, _, _, stored = SPAN.unpack_from(head, RECORD.size)
    if kind != CHUNK or content != stored or length != SPAN.size + content:
        raise ValueError(f"no chunk of ballfg live at byte {offset}")
    chunk = Chunk(first, last, offset, content, ())
    for number in range(1, channels + 1):
        head = read(chunk.end, RECORD.size + INDEX.size)
        if len(head) < RECORD.size + INDEX.size:
            return None
        kind, length = RECORD.unpack_from(head)
        channel, entries = INDEX.unpack_from(head, RECORD.size)
        if (kind, channel, length) != (MESSAGE_INDEX, number, INDEX.size + entries):
            raise ValueError(f"no index of channel {number} at byte {chunk.end}")
        chunk = Chunk(first, last, offset, content, (*chunk.counts, entries // ENTRY.size))
    return chunk


def _record(kind: int, content: bytes | bytearray) -> bytes:
    return RECORD.pack(kind, len(content)) + content


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()
