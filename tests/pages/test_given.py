"""Paths are recognised by what they are, and those that are nothing say what they could be."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest

from ballfg.pages.given import recognise
from ballfg.tracks import TableWriter
from tests.pages.made import Made, write


def test_in_any_order(made: Made, report: Path) -> None:
    for paths in permutations((made.dataset, made.states, made.predictions)):
        given = recognise([report, *paths])
        assert given.dataset is not None
        assert (given.states.path, given.predictions.path) == (made.states, made.predictions)
        assert given.diagnosis["verdict"] == "effect found"
    assert recognise([report / "report.json"]).diagnosis == given.diagnosis


def test_rows_are_those_of_the_track_in_order_of_time(made: Made, tmp_path: Path) -> None:
    shuffled = tmp_path / "shuffled.csv"
    head, *rows = made.states.read_text().splitlines()
    shuffled.write_text("\n".join([head, *reversed(rows)]) + "\n")
    table = recognise([shuffled]).states
    for name, fall in made.falls.items():
        assert table.of(name)[:, 0] == pytest.approx(fall.times)
        assert table.of(name)[:, 1:10] == pytest.approx(fall.states())
    assert table.of("no such shot").shape == (0, 19)


def test_parquet_holds_the_same(made: Made, tmp_path: Path) -> None:
    table = recognise([made.predictions]).predictions
    with TableWriter(tmp_path / "p.parquet") as writer:
        for name in table.rows:
            columns = zip(("t", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z"), table.of(name).T, strict=True)
            writer.write({"trajectory": name} | dict(columns))
    again = recognise([tmp_path / "p.parquet"]).predictions
    assert (again.values == table.values).all()


def test_what_cannot_be_shown_says_what_could_be(made: Made, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "broken.parquet").write_text("no table")
    write(tmp_path / "other.csv", ("a", "b"), [(1, 2)])
    places = ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z")
    write(tmp_path / "events.csv", ("trajectory", "event", "t", *places), [("a", "apex", 0.5, *[0.1] * 6)])
    for name, message in (
        ("missing", "does not exist; it could be a dataset"),
        ("notes.txt", "must be a dataset .*ending is '.txt'"),
        ("other.json", "its fields are others"),
        ("broken.json", "is no JSON"),
        ("broken.parquet", "must be a whole Parquet file"),
        ("other.csv", "must be a dataset .*columns are a, b"),
        ("events.csv", "must be a dataset .*columns are trajectory, event, t"),
        ("", "holds neither dataset.yaml nor report.json"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            recognise([tmp_path / name])
    with pytest.raises(ValueError, match="Give its folder"):
        recognise([made.dataset / "tracks.csv"])
    with pytest.raises(ValueError, match="one states can be shown"):
        recognise([made.states, made.states])
    with pytest.raises(ValueError, match="something must be given"):
        recognise([])


def test_cells_that_are_no_numbers_are_refused(made: Made, tmp_path: Path) -> None:
    head, first, *_ = made.predictions.read_text().splitlines()
    bad = ((["a", "x"], "number in each cell"), (["a", ""], "finite number of seconds"), ([], "rows"))
    far = (["a", "0.5", "3e12"], "x must be at most 1e[+]12 in SI units; row 1 has 3e[+]12")
    for cells, message in (*bad, far):
        path = tmp_path / "bad.csv"
        rows = [",".join([*cells, *first.split(",")[len(cells) :]])] if cells else []
        path.write_text("\n".join([head, *rows]) + "\n")
        with pytest.raises(ValueError, match=message):
            recognise([path])
