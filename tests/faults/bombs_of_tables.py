"""Bombs in tables and text: Parquet, CSV, JSON, YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ballfg.state import SIGMA_NAMES, STATE_NAMES
from tests.faults.bombs_of_arrays import Bomb, Write

LONG = 1_000_000
"""Characters of a name."""
ROWS = 1500
"""Rows with such a name."""
ENDLESS = 50_000_000
"""Characters of a line."""
JSON = 30_000_000
"""Characters of JSON."""
ZEROS = 40_000_000
"""Rows of zeros: 320 MB for each column in memory, some kB in a file."""


def _parquet(columns: Mapping[str, object], **options: object) -> Write:
    def write(path: Path) -> None:
        pq.write_table(pa.table(dict(columns)), path, compression="zstd", **options)

    return write


def _words(words: list[str], rows: int = ROWS) -> pa.Array:
    """A column of texts in turn, which takes no more memory than the words."""
    return pa.DictionaryArray.from_arrays(pa.array(np.arange(rows, dtype=np.int32) % len(words)), pa.array(words))


def _named(words: list[str], columns: tuple[str, ...] = ("t", "x", "y", "z")) -> Write:
    """A table whose rows have long names; the file says that they are plain texts."""
    numbers = dict.fromkeys(columns, np.arange(float(ROWS)) / 100.0)
    return lambda path: _parquet({"trajectory": _words(words), **numbers}, store_schema=False)(path)


def _zeros(path: Path) -> None:
    many = pa.array(np.zeros(ZEROS))
    columns = {"trajectory": _words(["a"], ZEROS), **dict.fromkeys(("t", "x", "y", "z"), many)}
    _parquet(columns, store_schema=False)(path)


def _repeated_list(path: Path) -> None:
    """Lists of one long word, again and again."""
    lists = pa.ListArray.from_arrays(pa.array(np.arange(0, 20_001, 10, dtype=np.int32)), _words(["a" * LONG], 20_000))
    numbers = dict.fromkeys(("t", "x", "y", "z"), np.arange(2000.0))
    _parquet({**numbers, "l": lists}, store_schema=False)(path)


def _many_groups(path: Path) -> None:
    schema = pa.schema([(name, pa.float64()) for name in ("t", "x", "y", "z", *(f"c{k}" for k in range(200)))])
    one = pa.table([np.zeros(1)] * len(schema), schema=schema)
    with pq.ParquetWriter(path, schema) as writer:
        for _ in range(600):
            writer.write_table(one)


def _many_columns(path: Path) -> None:
    _parquet({f"c{k}": np.zeros(2) for k in range(60_000)}, write_statistics=False)(path)


def _text(text: str, count: int, before: str = "", after: str = "") -> Write:
    """Text that repeats, between a beginning and an end."""
    return lambda path: path.write_text(before + text * (count // len(text)) + after, encoding="utf-8")


def _hole(before: str) -> Write:
    """A file that is a hole behind its first bytes: on the disk it takes some kB."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(before.encode())
            file.truncate(4_000_000_000)

    return write


def _json_names(path: Path) -> None:
    path.write_text("{" + ",".join(f'"{k:x}":0' for k in range(JSON // 10)) + "}")


def _wide_csv(path: Path) -> None:
    path.write_text(",".join(f"c{k}" for k in range(20_000)) + "\n" + ("1," * 20_000)[:-1] + "\n")


STATES = ("t", *STATE_NAMES, *SIGMA_NAMES)
TRACKS = "trajectory,t,x,y,z\n"
ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{two}: &{two} [{', '.join([f'*{one}'] * 9)}]\n" for one, two in zip("abcdefgh", "bcdefghi", strict=True)
)

TABLES: dict[str, Bomb] = {
    "parquet/one long name, tracks": ("parquet_dataset", "tracks.parquet", _named(["a" * LONG])),
    "parquet/one long name, import": ("import", "x.parquet", _named(["a" * LONG])),
    "parquet/one long name, states": ("results", "states.parquet", _named(["a" * LONG], STATES)),
    "parquet/names of 10 kB": (
        "parquet_dataset",
        "tracks.parquet",
        _named([f"{k}" * 2000 for k in range(10_000, 12_000)]),
    ),
    "parquet/zeros, tracks": ("parquet_dataset", "tracks.parquet", _zeros),
    "parquet/zeros, import": ("import", "x.parquet", _zeros),
    "parquet/lists of one long word": ("import", "x.parquet", _repeated_list),
    "parquet/groups without end": ("import", "x.parquet", _many_groups),
    "parquet/columns without end": ("import", "x.parquet", _many_columns),
    "csv/endless line, tracks": ("dataset", "tracks.csv", _text("1,", ENDLESS, TRACKS)),
    "csv/endless word, tracks": ("dataset", "tracks.csv", _text("a", ENDLESS, TRACKS)),
    "csv/endless cell in quotes": ("dataset", "tracks.csv", _text("a\n", ENDLESS, TRACKS + '"')),
    "csv/endless header": ("dataset", "tracks.csv", _text("a,", ENDLESS)),
    "csv/endless line, labels": ("dataset", "labels.csv", _text("1,", ENDLESS, "trajectory,group\n")),
    "csv/endless line, speeds": ("dataset", "speeds.csv", _text("1,", ENDLESS, "trajectory,t,speed,sigma\n")),
    "csv/endless line, detections": ("detections", "detections.csv", _text("1,", ENDLESS, "t,camera,u,v\n")),
    "csv/endless header, detections": ("detections", "detections.csv", _text("a,", ENDLESS)),
    "csv/endless line, stamps": ("detections", "stamps.csv", _text("1,", ENDLESS, "frame,t\n")),
    "csv/endless line, states": ("results", "states.csv", _text("1,", ENDLESS)),
    "csv/endless line, import": ("import", "x.csv", _text("1,", ENDLESS)),
    "csv/endless word, import": ("import", "x.csv", _text("a", ENDLESS)),
    "csv/spaces without end, import": ("import", "x.txt", _text("1 ", ENDLESS)),
    "csv/columns without end, import": ("import", "x.csv", _wide_csv),
    "csv/a hole, tracks": ("dataset", "tracks.csv", _hole(TRACKS)),
    "csv/a hole, import": ("import", "x.csv", _hole("t,x,y,z\n" + "1,2,3,4\n" * 1000)),
    "json/numbers on one line": ("import", "x.json", _text("0,", JSON, "[", "0]")),
    "json/empty lists": ("import", "x.json", _text("[],", JSON, "[", "0]")),
    "json/empty mappings": ("import", "x.json", _text("{},", JSON, "[", "0]")),
    "json/names": ("import", "x.json", _json_names),
    "json/lists in lists": ("import", "x.json", _text("[", JSON)),
    "json/small lists": ("import", "x.json", _text("[[0]],", JSON // 3, "[", "0]")),
    "json/lines": ("import", "x.jsonl", _text("[[],[],[],[],[],[],[]]\n", JSON)),
    "json/a hole": ("import", "x.json", _hole('[{"t": 0}' + " " * 5000)),
    "json/report": ("report", "report.json", _text("[],", JSON, '{"verdict": [', "0]}")),
    "yaml/aliases": ("dataset", "dataset.yaml", _text(ALIASES, len(ALIASES))),
    "yaml/large": ("dataset", "dataset.yaml", _text("- 0\n", 17_000_000)),
    "yaml/values": ("dataset", "dataset.yaml", _text("0,", 8_000_000, "name: [", "0]")),
    "yaml/nested": ("model", "model.yaml", _text("[", 15_000_000)),
    "yaml/a long word": ("model", "model.yaml", _text("a", 15_900_000, "flight: ")),
    "yaml/values, cameras": ("cameras", "cameras.yaml", _text("[0],", 2_000_000, "cameras: [", "0]")),
    "yaml/values, table": ("table", "table.yaml", _text("a: 0\n", 15_000_000)),
    "yaml/conformal": ("conformal", "scales.yaml", _text("- [0]\n", 5_000_000)),
}
