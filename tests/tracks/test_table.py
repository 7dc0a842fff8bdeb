import csv

import numpy as np
import pyarrow.parquet as pq
import pytest

from ballfg.tracks import TableWriter

AWKWARD = np.array([0.1 + 0.2, 1 / 3, -0.0, 5e-324, 1.7976931348623157e308, 1e22, 123456789.123456789, -1e-7])


def _csv(path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


def test_csv_is_plain_and_exact(tmp_path):
    path = tmp_path / "states.csv"
    with TableWriter(path) as table:
        table.write({"trajectory": "000", "n": [1, 2], "x": AWKWARD[:2]})
        table.write({"trajectory": ["b", "c"], "n": [3, 4], "x": [1, 2]})
    assert path.read_text() == ("trajectory,n,x\n000,1,0.30000000000000004\n000,2,0.3333333333333333\nb,3,1\nc,4,2\n")


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_floats_come_back_bit_for_bit(tmp_path, ending):
    values = np.concatenate([AWKWARD, np.random.default_rng(0).normal(size=1000)])
    path = tmp_path / f"a{ending}"
    with TableWriter(path) as table:
        for part in np.array_split(values, 7):
            table.write({"x": part})
    if ending == ".csv":
        got = np.array([float(row[0]) for row in _csv(path)[1:]])
    else:
        got = pq.read_table(path)["x"].to_numpy()
    assert got.tobytes() == values.tobytes()


def test_text_is_quoted_where_it_must_be(tmp_path):
    with TableWriter(tmp_path / "a.csv") as table:
        table.write({"a,b": ['x,"y"', "line\nbreak", "plain"], "n": [1.5, np.nan, 3]})
    assert _csv(tmp_path / "a.csv") == [["a,b", "n"], ['x,"y"', "1.5"], ["line\nbreak", "nan"], ["plain", "3"]]


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_many_small_blocks_are_gathered(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    with TableWriter(path) as table:
        for i in range(1400):
            table.write({"trajectory": f"{i}", "x": np.full(100, float(i))})
    if ending == ".csv":
        rows = _csv(path)
        assert len(rows) == 140_001
        assert rows[-1] == ["1399", "1399"]
    else:
        file = pq.ParquetFile(path)
        assert (file.metadata.num_rows, file.num_row_groups) == (140_000, 3)


def test_a_table_without_rows_has_a_header(tmp_path):
    with TableWriter(tmp_path / "a.csv") as table:
        table.write({"trajectory": "a", "x": np.empty(0)})
    assert (tmp_path / "a.csv").read_text() == "trajectory,x\n"


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_what_was_there(tmp_path, ending, error):
    path = tmp_path / f"a{ending}"
    path.write_text("old")

    def half() -> None:
        with TableWriter(path) as table:
            table.write({"x": np.zeros(100_000)})
            table.write({"x": np.zeros(10)})
            raise error

    with pytest.raises(error):
        half()
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "old"


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_a_full_disk_leaves_nothing_behind(tmp_path, ending):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))  # writing more raises an OSError
        with pytest.raises(OSError, match="too large"), TableWriter(tmp_path / f"a{ending}") as table:
            table.write({"x": np.random.default_rng(0).normal(size=10_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_the_name_appears_only_at_the_end(tmp_path):
    path = tmp_path / "a.csv"
    with TableWriter(path) as table:
        table.write({"x": np.zeros(100_000)})
        assert not path.exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.csv"]


def test_bad_paths_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"out must end in \.csv or \.parquet; got 'states\.txt'"):
        TableWriter("states.txt", name="out")
    with pytest.raises(ValueError, match=r"path must end in \.csv or \.parquet; got 'states\.txt'\. Choose the format"):
        TableWriter("states.txt")
    with pytest.raises(FileNotFoundError, match=r"path must be in an existing folder; .*nowhere is none\. Create it"):
        TableWriter(tmp_path / "nowhere" / "a.csv")
    (tmp_path / "b.csv").mkdir()
    with pytest.raises(ValueError, match=r"path must be a file; .*b\.csv is a folder"):
        TableWriter(tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({}, "columns must name at least one column; got none."),
        ({"x": [1.0]}, "columns must be those of the first block, ['a', 'x']; got ['x']."),
        ({"x": [1.0], "a": ["s"]}, "columns must be those of the first block, ['a', 'x']; got ['x', 'a']."),
        ({"a": ["s"], "x": [1.0, 2.0]}, "columns must have one length; got {'a': 1, 'x': 2}. Pass one value per row."),
        ({"a": ["s"], "x": ["t"]}, "columns['x'] must be double as in the first block; got string."),
        ({"a": ["s"], "x": [[1.0]]}, "columns['x'] must have shape (n,); got (1, 1). Pass one column at a time."),
        ({"a": [None], "x": [1.0]}, "columns['a'] must hold numbers or text; got None. Convert it."),
        ({"a": ["s"], "x": [1j]}, "columns['x'] must hold numbers or text; got dtype complex128."),
    ],
)
def test_bad_blocks_are_named_and_leave_no_file(tmp_path, second, message):
    def write() -> None:
        with TableWriter(tmp_path / "a.csv") as table:
            table.write({"a": ["s"], "x": [1.0]})
            table.write(second)

    with pytest.raises(ValueError, match=r".") as caught:
        write()
    assert message in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_writer_must_be_entered_and_used(tmp_path):
    with pytest.raises(RuntimeError, match="write must be called inside `with TableWriter"):
        TableWriter(tmp_path / "a.csv").write({"x": [1.0]})
    with (
        pytest.raises(ValueError, match=r"a table must have columns; nothing was written\. Write at least one block"),
        TableWriter(tmp_path / "a.csv"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
