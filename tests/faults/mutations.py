"""Damage to the bytes of a file: at random places, and where its format expects something."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import yaml

MOST = 1 << 20
"""Bytes that a repeated line may come to: beyond, a reader would be timed at a large file, not at a damaged one."""
NASTY = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-0", "-1", "0", "1e999", "99999999999999999999", "0x10", "1_0",
    "1,5", "1e", ".", "", " ", "9" * 5000, "x" * 100_000, "0." + "1" * 100_000, "é", "٣", "\u202e", "\ud7ff", "\x00",
    "\ufeff", '"', "'", ",", ";", "\n", "\r", "\t", "[", "]", "{", "}", "[]", "{}", "null", "true", "~", "2026-02-30",
    "!!python/object:os.system x", "!!float x", "&a [*a]", "*a", "<<: 1", "? [1]", "- - - -", "=1+1", "#N/A", "../..",
    "/", "[" * 3000, "{\"a\":" * 3000, "%", "%s", "{0}", "<!DOCTYPE a [<!ENTITY b 'c'>]>", "&lt;", "<a/>",
)  # fmt: skip
"""What takes the place of a number or a word."""
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 1e308, -1e308, 1e-320, 10**30, 2**63, 10**18, float("nan"), float("inf"), "", "x", "1",
    "x" * 100_000, [], {}, [[]], [None], [1, [2, [3]]], {"": 1}, {"a": {"a": {}}}, ["a", 1, None], [0.0] * 10_000,
    [[1.0, 2.0, 3.0]] * 3, [1.0, 2.0], "\x00", "é\u202e", "../..", "/dev/null", 0.5, 1_000_000_000,
)  # fmt: skip
"""What takes the place of a node of a tree."""
WORDS = {
    ".csv": ("trajectory", "t", "sigma_x", "x", "\r\n", "\n\n", '"a,b"', '"', "\xff", "camera", "#"),
    ".yaml": (
        "learned:",
        "learned: .",
        "frame:",
        "noise:",
        "variations:",
        "measurement:",
        "---\n",
        "%YAML 1.0\n",
        "? ",
    ),
    ".json": ("NaN", "Infinity", "-", "1E400", "[[", "\\ud800", '"\\u0000"', ",,"),
    ".xml": ("<_>", "</data>", "<data>", "type_id", "<![CDATA[", "<!--", "opencv_storage"),
    ".h5": ("\x89HDF", "TREE", "HEAP", "SNOD", "OHDR", "FRHP"),
    ".parquet": ("PAR1",),
    ".mcap": ("\x89MCAP0\r\n",),
}
"""Tokens by format."""
EDGES = (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\0\x40", b"\x01\0\0\0")
"""Sizes at the edges of what fields of a header hold."""

Change = Callable[[bytes, random.Random], bytes]
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]\w*")


def damaged(content: bytes, ending: str, rng: random.Random) -> bytes:
    """The content after one to three changes.

    Args: content: of the good file.  ending: tells the format.  rng: makes all choices.
    """
    changes = [*_BYTES, *_CHANGES.get(ending, ())]
    if ending in _TEXT:
        changes += 3 * _WORDS
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = rng.choice(changes)(content, rng) if rng.random() < 0.9 else _token(content, ending, rng)
    return content


def _place(content: bytes, rng: random.Random) -> int:
    return rng.randrange(len(content) + 1)


def _span(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = _place(content, rng)
    return start, min(len(content), start + rng.choice((1, 2, 8, 64, 512)))


def _flipped(content: bytes, rng: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 4, 32)) if content else 0):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: _place(content, rng)]


def _without(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    return content[:start] + content[end:]


def _doubled(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    return content[:end] + content[start:end] * rng.choice((1, 1, 100)) + content[end:]


def _inserted(content: bytes, rng: random.Random) -> bytes:
    at = _place(content, rng)
    return content[:at] + rng.randbytes(rng.choice((1, 4, 64))) + content[at:]


def _edge(content: bytes, rng: random.Random) -> bytes:
    at, edge = _place(content, rng), rng.choice(EDGES) * rng.choice((1, 2))
    return content[:at] + edge + content[at + len(edge) :]


def _zeroed(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    return content[:start] + bytes(end - start) + content[end:]


def _token(content: bytes, ending: str, rng: random.Random) -> bytes:
    at = _place(content, rng)
    return content[:at] + rng.choice(WORDS.get(ending, NASTY)).encode() + content[at:]


def _replaced(pattern: re.Pattern[bytes]) -> Change:
    """One match, or all equal ones, in place of which something else stands."""

    def change(content: bytes, rng: random.Random) -> bytes:
        found = list(pattern.finditer(content))
        if not found:
            return content
        match = rng.choice(found)
        new = rng.choice(NASTY).encode("utf-8", "surrogatepass")
        if rng.random() < 0.2:
            new = match[0] + new
        if rng.random() < 0.1 and len(new) < 100:
            return content.replace(match[0], new)
        return content[: match.start()] + new + content[match.end() :]

    return change


def _lines(content: bytes, rng: random.Random) -> bytes:
    """A line dropped, doubled, emptied or moved."""
    lines = content.split(b"\n")
    at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[to:to] = [lines[at]] * min(rng.choice((1, 1, 1000)), 1 + MOST // (1 + len(lines[at])))
    elif kind == 2:
        lines[at] = rng.choice((b"", b" ", b",", b"#"))
    elif kind == 3:
        lines[at], lines[to] = lines[to], lines[at]
    else:
        lines = lines[: at + 1]
    return b"\n".join(lines)


def _cells(content: bytes, rng: random.Random) -> bytes:
    """A column of a table dropped, doubled, swapped, emptied, filled or renamed."""
    rows = [line.split(b",") for line in content.split(b"\n")]
    width = len(rows[0])
    one, other, kind = rng.randrange(width), rng.randrange(width), rng.randrange(6)
    filling = rng.choice(NASTY[:17]).encode()
    for number, row in enumerate(rows):
        if len(row) != width or (kind in (3, 4) and number == 0):
            continue
        if kind == 0:
            del row[one]
        elif kind == 1:
            row.append(row[one])
        elif kind == 2:
            row[one], row[other] = row[other], row[one]
        elif kind in (3, 4):
            row[one] = b"" if kind == 3 else filling
        elif number == 0:
            row[one] = rng.choice((row[other], filling))
    return b"\n".join(b",".join(row) for row in rows)


def _changed_tree(content: Any, rng: random.Random) -> Any:
    """One node of a tree replaced, dropped, doubled or renamed."""
    nodes: list[tuple[Any, Any]] = []
    waiting = [content]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            nodes += [(node, key) for key in node]
            waiting += node.values()
        elif isinstance(node, list):
            nodes += [(node, at) for at in range(len(node))]
            waiting += node
    if not nodes or rng.random() < 0.03:
        return rng.choice(VALUES)
    parent, key = rng.choice(nodes)
    kind = rng.randrange(5)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, dict):
        parent[rng.choice(("x", "", "0", str(key) + "s", str(key).upper()))] = parent.pop(key)
    elif kind == 1:
        parent += parent[key : key + 1] * rng.choice((1, 5))
    elif kind == 2:
        other, there = rng.choice(nodes)
        parent[key] = json.loads(json.dumps(other.get(there) if isinstance(other, dict) else other[there : there + 1]))
    else:
        parent[key] = rng.choice(VALUES)
    return content


def _json_tree(content: bytes, rng: random.Random) -> bytes:
    try:
        tree = json.loads(content)
    except (ValueError, RecursionError):
        return _flipped(content, rng)
    return json.dumps(_changed_tree(tree, rng), ensure_ascii=rng.random() < 0.5).encode("utf-8", "surrogatepass")


def _json_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = _json_tree(lines[at], rng)
    return b"\n".join(lines)


def _yaml_tree(content: bytes, rng: random.Random) -> bytes:
    try:
        tree = yaml.load(content, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        tree = json.loads(json.dumps(tree))  # aliases written out
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        return _flipped(content, rng)
    return yaml.safe_dump(_changed_tree(tree, rng), sort_keys=False, allow_unicode=True).encode("utf-8", "replace")


def _zip_member(content: bytes, rng: random.Random) -> bytes:
    """A member of an archive damaged, and the archive written again, with sums that are right."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, RuntimeError, NotImplementedError, zlib.error):
        return _flipped(content, rng)
    if not members:
        return content
    name = rng.choice(list(members))
    kind = rng.randrange(8)
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[rng.choice((name + "x", "../" + name, "", "a.npy"))] = members.pop(name)
    elif kind == 2:
        members[name] += bytes(rng.choice((1000, 50_000_000)))
    elif name.endswith(".npy") and rng.random() < 0.7:
        members[name] = _npy(members[name], rng)
    else:
        text = name.endswith((".xml", ".rels"))
        members[name] = rng.choice([*_BYTES, *(3 * _WORDS if text else ())])(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for member, data in members.items():
            archive.writestr(zipfile.ZipInfo(member), data)
    return out.getvalue()


def _npy(content: bytes, rng: random.Random) -> bytes:
    """Another header of an array: type, order, shape."""
    if not content.startswith(b"\x93NUMPY\x01"):
        return _flipped(content, rng)
    length = struct.unpack("<H", content[8:10])[0]
    shape = rng.choice(("()", "(0,)", "(3, 4)", "(-1,)", "(1000000000,)", "(10**9, 3)", "(2000000000, 3)", "(4, 0, 3)"))
    kind = rng.choice(("<f8", "|O", "<U9", "<i1", "|b1", "<c16", "<M8[ns]", "|V8", "<f2", "x", ">f8", "<U1000000000"))
    header = f"{{'descr': {kind!r}, 'fortran_order': {rng.random() < 0.3}, 'shape': {shape}, }}".encode() + b"\n"
    if rng.random() < 0.2:
        header = rng.choice(NASTY).encode()[:9999]
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + content[10 + length :]


def _safetensors(content: bytes, rng: random.Random) -> bytes:
    """Another header: names, types, shapes and offsets of tensors."""
    if len(content) < 8:
        return content
    length = int.from_bytes(content[:8], "little")
    header = _json_tree(content[8 : 8 + length], rng)
    return len(header).to_bytes(8, "little") + header + content[8 + length :]


_BYTES: list[Change] = [_flipped, _cut, _without, _doubled, _inserted, _edge, _zeroed]
_WORDS: list[Change] = [_replaced(_NUMBER), _replaced(_WORD), _lines]
_TEXT = (".csv", ".tsv", ".txt", ".yaml", ".yml", ".json", ".jsonl", ".xml", ".lines")
_CHANGES: dict[str, list[Change]] = {
    ".csv": 4 * [_cells], ".yaml": 8 * [_yaml_tree], ".json": 8 * [_json_tree], ".jsonl": 8 * [_json_line],
    ".lines": 8 * [_json_line], ".npz": 12 * [_zip_member], ".npy": 4 * [_npy], ".xlsx": 12 * [_zip_member],
    ".safetensors": 6 * [_safetensors],
}  # fmt: skip
