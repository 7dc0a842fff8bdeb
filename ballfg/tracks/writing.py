"""Writes a dataset as a stream, all of it or nothing."""

import csv
import json
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Final, Literal, TextIO

from ballfg.checks import check_choice, check_instance, check_path
from ballfg.files.spreadsheet import guarded
from ballfg.files.whole_folder import whole_folder
from ballfg.tracks.dataset import TRACK_FILES, checked
from ballfg.tracks.info import INFO_FILE, DatasetInfo, write_info
from ballfg.tracks.labels import LABELS_FILE
from ballfg.tracks.rows import KEY, SIGMAS, VALUES
from ballfg.tracks.table import TableWriter
from ballfg.tracks.track import Track

DATASET_FILES = (INFO_FILE, *TRACK_FILES, LABELS_FILE)  # all possible names of a dataset's files
TRUTH_FILE: Final = "truth.yaml"  # settings of a simulation; in its folder, the files below belong to it alone
TRUTH_FILES: Final = (TRUTH_FILE, "truth.csv", "truth.parquet", "model.yaml", "model.learned-*")
"""All names, or patterns of names, of a simulation's further files."""
_SPOOL = "labels.jsonl"


def write_dataset(
    folder: str | PathLike[str],
    info: DatasetInfo,
    tracks: Iterable[Track],
    file_format: Literal["csv", "parquet"] = "csv",
) -> None:
    """Writes `dataset.yaml`, the table of tracks and, if any track carries labels, `labels.csv`.

    The files are written in a hidden folder and moved to their names when all are complete; after an exception or
    Ctrl-C, the previous files are untouched. An existing dataset is replaced, other files stay. Tracks are consumed one
    by one. The written dataset can be read: the rules of `read_dataset` hold here.

    Args:
        folder: created if it does not exist; its parent must.
        info: the content of `dataset.yaml`.
        tracks: at least one; each with at least two samples and a unique name; sigmas for all or for none.
        file_format: "csv" (floats keep all their digits) or "parquet".
    Raises: ValueError: another format, no tracks, or a track that breaks a rule; the message names it.
        FileNotFoundError: the folder's parent does not exist.
    """
    check_choice("file_format", file_format, ("csv", "parquet"))
    check_instance("info", info, DatasetInfo, "Make one with DatasetInfo(name, table_height, ball).")
    path = check_path("folder", folder)
    with whole_folder(path, earlier=DATASET_FILES, argument="folder") as stage:
        write_info(stage / INFO_FILE, info)
        with (stage / _SPOOL).open("x", encoding="utf-8") as spool:
            label_names = _write_tracks(stage / f"tracks.{file_format}", info, tracks, spool)
        if label_names:
            with (stage / LABELS_FILE).open("x", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(map(guarded, (KEY, *label_names)))
                with (stage / _SPOOL).open(encoding="utf-8") as lines:
                    for cells in map(json.loads, lines):
                        row = (cells.get(name, "") for name in (KEY, *label_names))
                        writer.writerow(guarded(cell) if isinstance(cell, str) else cell for cell in row)
        (stage / _SPOOL).unlink()


def _write_tracks(path: Path, info: DatasetInfo, tracks: Iterable[Track], spool: TextIO) -> list[str]:
    """Writes the table, and each track's labels as one line of JSON; returns the names of all labels."""
    label_names: dict[str, None] = {}
    with TableWriter(path) as table:
        for track in checked(tracks, info):
            columns = dict(zip(VALUES[1:], track.positions.T, strict=True))
            if track.sigmas is not None:
                columns |= dict(zip(SIGMAS, track.sigmas.T, strict=True))
            table.write({KEY: track.name, VALUES[0]: track.times, **columns})
            if track.labels:
                label_names.update(dict.fromkeys(track.labels))
                spool.write(json.dumps({KEY: track.name, **track.labels}) + "\n")
    return list(label_names)
