"""Whole datasets through a command: the same bytes whatever the format, the number of processes and the block."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from ballfg.tracks import Dataset, Track, read_dataset, write_dataset
from tests.commands import refused, status


@pytest.fixture(scope="module")
def states(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The table that one pass makes of the dataset as it is."""
    out = tmp_path_factory.mktemp("states") / "states.parquet"
    assert status("estimate", folder, "--method", "sliding-window", "--jobs", 1, "--out", out) == 0
    return out.read_bytes()


def test_row_groups_and_formats_change_nothing(folder: Path, states: bytes, tmp_path: Path) -> None:
    dataset = read_dataset(folder)
    held = list(dataset)  # all of it in memory, from where it is written again
    for form in ("csv", "parquet"):
        write_dataset(tmp_path / form, dataset.info, held, form)
    table = pq.read_table(folder / "tracks.parquet")
    write_dataset(tmp_path / "small groups", dataset.info, held, "parquet")
    pq.write_table(table, tmp_path / "small groups" / "tracks.parquet", row_group_size=17)
    for form in ("csv", "parquet", "small groups"):
        out = tmp_path / "states.parquet"
        assert status("estimate", tmp_path / form, "--method", "sliding-window", "--out", out) == 0
        assert out.read_bytes() == states


def test_tracks_that_interleave_are_regrouped_in_their_order(folder: Path, states: bytes, tmp_path: Path) -> None:
    dataset = read_dataset(folder)
    write_dataset(tmp_path / "mixed", dataset.info, dataset, "csv")
    table = tmp_path / "mixed" / "tracks.csv"
    header, *rows = table.read_text().splitlines(keepends=True)
    first = {name: number for number, name in enumerate(dataset.names)}
    rows.sort(key=lambda row: (float(row.split(",")[1]) > 0.1, first[row.split(",")[0]]))
    table.write_text(header + "".join(rows))
    out = tmp_path / "states.parquet"
    assert status("estimate", tmp_path / "mixed", "--method", "sliding-window", "--out", out) == 0
    assert out.read_bytes() == states


def test_a_table_that_is_damaged_while_it_is_read_leaves_no_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Track] = []

    def broken(dataset: Dataset):
        for track in whole(dataset):
            if len(written) == 20:
                (folder_copy / "tracks.parquet").write_bytes(b"PAR1 and no more")
                yield from read_dataset(folder_copy)
            written.append(track)
            yield track

    whole = Dataset.__iter__
    folder_copy = tmp_path / "shots"
    dataset = read_dataset(folder)
    write_dataset(folder_copy, dataset.info, dataset, "parquet")
    monkeypatch.setattr(Dataset, "__iter__", broken)
    out = tmp_path / "states.parquet"
    out.write_text("an earlier result")
    arguments = ("estimate", folder_copy, "--method", "sliding-window", "--jobs", 1, "--out", out)
    assert "must be a whole Parquet file" in refused(*arguments)
    assert out.read_text() == "an earlier result"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["shots", "states.parquet"]


def test_a_parquet_file_that_ends_in_the_middle_is_refused_at_once(folder: Path, tmp_path: Path) -> None:
    dataset = read_dataset(folder)
    write_dataset(tmp_path / "half", dataset.info, dataset, "parquet")
    table = tmp_path / "half" / "tracks.parquet"
    table.write_bytes(table.read_bytes()[: table.stat().st_size // 2])
    assert "must be a whole Parquet file" in refused("estimate", tmp_path / "half", "--out", tmp_path / "states.csv")
    assert not (tmp_path / "states.csv").exists()
