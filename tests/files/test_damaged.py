"""Bounds of what is held whole, and that each is told in one line with its number."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ballfg.files.damaged import FREE, MAX_PIXELS, RATIO, check_parts, check_pixels, check_unpacked, whole_content
from ballfg.files.json_file import MAX_VALUES, has_too_many, parse_json
from ballfg.files.parquet import open_parquet, texts_of
from ballfg.files.weights import read_tensors


def test_what_a_file_unpacks_to_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(bytes(1000))
    check_unpacked(path, FREE + 1000 * RATIO)
    with pytest.raises(ValueError, match=r"a\.npz must unpack to at most 32 MB, .*; it says 80000 MB"):
        check_unpacked(path, 80_000_000_000)


def test_a_file_of_holes_is_not_held(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with path.open("wb") as file:
        file.truncate(10_000_000_000)
    with pytest.raises(ValueError, match=r"a\.csv must have at most 250 MB; it has 10000 MB"):
        whole_content(path)


def test_pixels_and_parts_are_counted(tmp_path: Path) -> None:
    check_pixels(tmp_path, 8000, MAX_PIXELS // 8000)
    for width, height in ((8000, MAX_PIXELS // 8000 + 1), (0, 5), (-3, 5)):
        with pytest.raises(ValueError, match=f"at most 64 million pixels; it says {width} x {height}"):
            check_pixels(tmp_path, width, height)
    check_parts(tmp_path, "arrays", 3, 3)
    with pytest.raises(ValueError, match="at most 3 arrays; got 4"):
        check_parts(tmp_path, "arrays", 4, 3)


def test_json_is_counted_before_it_is_parsed() -> None:
    """The most values, and one more: each comma is one, and the list is four."""
    assert not has_too_many("[" + "0," * (MAX_VALUES - 4) + "0]")
    with pytest.raises(ValueError, match="it must hold at most 8000000 values"):
        parse_json("[" + "0," * (MAX_VALUES - 3) + "0]")


def test_a_name_of_a_megabyte_is_held_once(tmp_path: Path) -> None:
    """Rows of plain texts that the file keeps as a dictionary share one text, cut where no name is so long."""
    path = tmp_path / "a.parquet"
    words = pa.DictionaryArray.from_arrays(pa.array([0, 1, 0, None], pa.int32()), ["a" * 1_000_000, "b"])
    pq.write_table(pa.table({"name": words}), path, store_schema=False)
    with open_parquet(path) as file:
        assert file.schema.to_arrow_schema().field("name").type == pa.string()
        found = texts_of(file.read()["name"])
    assert found == ["a" * 2000, "b", "a" * 2000, None]
    assert found[0] is found[2]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({f"c{k}": np.zeros(1) for k in range(10_001)}, "at most 10000 columns; got 10001"),
        ({"t": np.zeros(6_000_000)}, "must unpack to at most 3"),
    ],
)
def test_parquet_is_bounded_by_its_metadata(tmp_path: Path, columns: dict[str, np.ndarray], message: str) -> None:
    pq.write_table(pa.table(columns), tmp_path / "a.parquet", compression="zstd")
    with pytest.raises(ValueError, match=rf"a\.parquet .*{message}"):
        open_parquet(tmp_path / "a.parquet")


def test_a_header_of_weights_is_bounded(tmp_path: Path) -> None:
    (tmp_path / "a.safetensors").write_bytes((1_000_001).to_bytes(8, "little") + b" " * 1_000_001)
    with pytest.raises(
        ValueError, match=r"a\.safetensors must be a whole safetensors file; .* header has 1000001 bytes"
    ):
        read_tensors(tmp_path / "a.safetensors")
