"""A folder that is exchanged while it is read is read again."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from ballfg.files.whole_folder import of_one_state, whole_folder
from ballfg.tracks import Ball, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo


def write(folder: Path, text: str) -> None:
    with whole_folder(folder, earlier=("*",)) as stage:
        for name in "ab":
            (stage / name).write_text(text)


def test_both_files_are_of_one_state(tmp_path: Path) -> None:
    write(tmp_path / "d", "0")
    tries: list[str] = []

    @of_one_state
    def read(folder: Path) -> str:
        first = (folder / "a").read_text()
        tries.append(first)
        if len(tries) < 4:
            write(tmp_path / "d", str(len(tries)))
        return first + (folder / "b").read_text()

    assert read(tmp_path / "d") == "33"
    assert tries == ["0", "1", "2", "3"]
    assert read(folder=tmp_path / "d") == "33"


def test_an_error_counts_if_the_folder_is_the_same(tmp_path: Path) -> None:
    write(tmp_path / "d", "0")
    tries: list[int] = []

    @of_one_state
    def read(path: Path) -> str:
        tries.append(path.stat().st_ino)
        if len(tries) == 1:
            write(tmp_path / "d", "1")
        raise ValueError("damaged")

    with pytest.raises(ValueError, match="damaged"):
        read(tmp_path / "d" / "a")  # a file in the folder
    assert len(tries) == 2
    with pytest.raises(ValueError, match="damaged"):
        of_one_state(lambda path: read(path))(tmp_path / "d")
    with pytest.raises(FileNotFoundError):
        of_one_state(os.stat)(tmp_path / "none")


def test_a_dataset_that_is_replaced_again_and_again_is_read_whole(tmp_path: Path) -> None:
    """Every state says its number in dataset.yaml, in the table and in the labels."""
    folder, stop = tmp_path / "d", threading.Event()

    def state(number: int) -> None:
        track = Track([0.0, 0.1], [[0.0, 0.0, 1.0], [number / 100, 0.0, 1.0]], name=f"t{number}", labels={"n": number})
        write_dataset(folder, DatasetInfo(f"d{number}", 0.76, Ball(0.02, 0.0027)), [track])

    def keep_writing() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            state(number)

    state(0)
    writer = threading.Thread(target=keep_writing)
    writer.start()
    try:
        seen = set()
        while len(seen) < 5:
            dataset = read_dataset(folder)
            number = int(dataset.info.name[1:])
            assert dataset.names == [f"t{number}"]
            seen.add(number)
    finally:
        stop.set()
        writer.join()
