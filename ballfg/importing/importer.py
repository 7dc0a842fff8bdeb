"""Implements `bf.import_tracks`: tracks of any units, axes and columns become a dataset."""

from collections.abc import Mapping
from os import PathLike
from typing import Any, Literal

from ballfg.checks import check_choice, check_flag, check_path
from ballfg.importing.choices import Choices, UndecidedError
from ballfg.importing.proposal import propose
from ballfg.importing.writing import write_import
from ballfg.tracks import Dataset, read_dataset
from ballfg.tracks.memory import dataset_in_memory


def import_tracks(
    data: Any,
    *,
    out: str | PathLike[str] | None = None,
    columns: Mapping[str, str] | None = None,
    length: str | None = None,
    time: str | None = None,
    up: str | None = None,
    flip: str | None = None,
    table_height: float | None = None,
    split_gap: float | None = None,
    ball: str | None = None,
    rate: float | None = None,
    key: str | None = None,
    topic: str | None = None,
    name: str | None = None,
    flights: bool = False,
    file_format: Literal["csv", "parquet"] = "csv",
    force: bool = False,
) -> Dataset:
    """Tracks from a user's own files or data, in SI units with z up; missing arguments are guessed.

    Columns are found by their names or numbers, units and the up axis by the fall of the ball, the table by bounces,
    shots by a column, restarts of time and gaps. `dataset.info.imported` has each guess with its reason.

    Args:
        data: a file or folder or several (CSV, JSON, Parquet, Excel, HDF5, npz, MATLAB, ROS bags), a DataFrame, a dict
            of arrays (n,) or (n, 3), an array (n, 4) of t, x, y, z, or a list of these, one a shot.
        out: folder to write the dataset to; None keeps it in memory.
        columns: role -> name of the column; roles are t, frame, trajectory, x, y, z, sigma_x, sigma_y, sigma_z.
        length: unit of positions and sigmas: m, cm, mm, in or ft.
        time: unit of stamps: s, ms, us or ns.
        up: axis of the source that points up: x, y, z, -x, -y or -z.
        flip: axis of the source whose sign is changed first, for a left-handed frame.
        table_height: z of the table's surface in the new frame, m; None: where bounces show it, else there is none.
        split_gap: s without samples after which a new shot begins.
        ball: table-tennis, tennis or a ball file; None: table-tennis.
        rate: Hz, for sources with numbers of frames in place of times.
        key: name of a table, sheet or group in a source that holds several.
        topic: of a ROS bag.
        name: of the dataset.
        flights: one track for each flight: what is held, rolls, rests or is lost is left out.
        file_format: "csv" or "parquet".
        force: replace a dataset in `out`.
    Returns: the dataset; it goes into `bf.estimate` as it is.
    Raises: UndecidedError: an unsafe guess, a ValueError that names the command's option and the argument. ValueError:
        unreadable data, or an argument that breaks its rule. FileNotFoundError: a missing file.
    """
    check_choice("file_format", file_format, ("csv", "parquet"))
    check_flag("force", force)
    check_flag("flights", flights)
    folder = None if out is None else check_path("out", out)
    choices = Choices(
        {} if columns is None else columns, length, time, up, flip, table_height, split_gap, ball, rate, key, topic,
        folder.name if name is None and folder is not None else name, flights,
    )  # fmt: skip
    try:
        proposal = propose(data, choices)
    except UndecidedError as question:
        raise question.in_python() from None
    if folder is None:
        return dataset_in_memory(proposal.info, proposal.tracks, proposal.notes)
    write_import(folder, proposal, file_format, force)
    return read_dataset(folder)
