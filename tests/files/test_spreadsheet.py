"""Cells that a spreadsheet would take for a formula are written as text, and read back as they were."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ballfg.files.spreadsheet import bare, guarded
from ballfg.pages.tables import Kind, read_table
from ballfg.tracks import TABLE_TENNIS, TableWriter, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo

NAMES = (
    "=1+1",
    "+cmd",
    "-x",
    "@SUM(A1)",
    "'=1",
    "''=1",
    "-1",
    "+5",
    "-1e-3",
    "'s",
    "a=b",
    "x;=1",
    "=a,b",
    '=a"b',
    "＝1",
)
BEGIN_FORMULAS = "=+-@\t\r\n＝＋－＠"


@given(st.text(alphabet=[*BEGIN_FORMULAS, "'", "1", ".", "e", "a"], max_size=6))
def test_every_text_comes_back(text: str) -> None:
    assert bare(guarded(text)) == text


@given(st.text(alphabet=[*BEGIN_FORMULAS, "'", "1", ".", "e", "a"], min_size=1, max_size=6))
def test_what_is_written_begins_no_formula(text: str) -> None:
    written = guarded(text)
    if written[0] in BEGIN_FORMULAS:
        float(written)  # a number, which computes nothing


@pytest.mark.parametrize("number", ["-1", "+5", "-1.5e-3", "+.5"])
def test_a_number_stays_as_it_is(number: str) -> None:
    assert guarded(number) == number


def _tracks() -> list[Track]:
    t = np.arange(20) / 100.0
    fall = np.column_stack([t, 0.1 * t, 1.5 - 4.9 * t**2])
    return [Track(t, fall, labels={"=label": name, "speed": -2.0}, name=name) for name in NAMES]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_names_and_labels_of_a_dataset_come_back(tmp_path: Path, ending: str) -> None:
    write_dataset(tmp_path, DatasetInfo("d", 0.0, TABLE_TENNIS), _tracks(), ending)  # type: ignore[arg-type]
    found = {track.name: track for track in read_dataset(tmp_path)}
    assert tuple(found) == NAMES
    texts = [name for name in NAMES if name not in ("-1", "+5", "-1e-3")]
    assert [found[name].labels["=label"] for name in texts] == texts
    assert all(track.labels["speed"] == -2.0 for track in found.values())
    for name in ("tracks.csv", "labels.csv"):
        if (tmp_path / name).is_file():
            with (tmp_path / name).open(encoding="utf-8", newline="") as file:
                cells = [cell for row in csv.reader(file) for cell in row]
            assert all(not cell.startswith(tuple(BEGIN_FORMULAS)) or float(cell) is not None for cell in cells)


def test_a_table_of_results_comes_back(tmp_path: Path) -> None:
    columns = dict.fromkeys(("t", *Kind.PREDICTIONS.value), np.array([-1.0, 2.0]))
    with TableWriter(tmp_path / "p.csv") as table:
        for name in NAMES:
            table.write({"trajectory": name, **columns})
    assert '\n"-1",' in (tmp_path / "p.csv").read_text(encoding="utf-8")  # as a name, and -1.0 as a number
    assert ",-1," in (tmp_path / "p.csv").read_text(encoding="utf-8")
    assert tuple(read_table(tmp_path / "p.csv", Kind.PREDICTIONS).rows) == NAMES


def test_a_file_that_others_wrote_has_the_same_names(tmp_path: Path) -> None:
    """=x without an apostrophe in one file is =x with one in another."""
    write_dataset(tmp_path, DatasetInfo("d", 0.0, TABLE_TENNIS), _tracks()[:1])
    for name in ("tracks.csv", "labels.csv"):
        path = tmp_path / name
        path.write_text(path.read_text(encoding="utf-8").replace("'=1+1", "=1+1"), encoding="utf-8")
        assert "'" not in path.read_text(encoding="utf-8").replace("'=label", "")
    (track,) = read_dataset(tmp_path)
    assert (track.name, track.labels["=label"]) == ("=1+1", "=1+1")
