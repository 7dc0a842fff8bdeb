"""Implements `bf.import_tracks`: tracks of any units, axes and columns become a dataset."""

import io
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ballfg.checks import check_choice, check_flag, check_path
from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.importing.choices import Choices, UndecidedError
from ballfg.importing.proposal import Proposal, propose
from ballfg.pages.html import Html, doubtful, items, section, table, tag, typed, whole_page
from ballfg.progress import counted
from ballfg.tracks import Dataset, Track, read_dataset, write_dataset
from ballfg.tracks.dataset import dataset_in_memory
from ballfg.tracks.info import INFO_FILE
from ballfg.tracks.writing import DATASET_FILES, TRUTH_FILE, TRUTH_FILES

PAGE: Final = "import.html"
_MOST_SHOTS: Final = 40  # number of drawn shots, evenly over the dataset
_MOST_POINTS: Final = 300  # largest number of drawn samples of a shot


def write_import(folder: Path, proposal: Proposal, file_format: Literal["csv", "parquet"], force: bool) -> None:
    """Writes the dataset and its page, or nothing. Raises: ValueError: a folder of others. FileNotFoundError."""
    simulated = (folder / TRUTH_FILE).is_file()
    with whole_folder(folder, earlier=(*DATASET_FILES, PAGE, *(TRUTH_FILES if simulated else ()))) as stage:
        check_replaceable(folder, mark=INFO_FILE, what="a dataset", force=force)
        write_dataset(stage, proposal.info, proposal.tracks, file_format)
        (stage / PAGE).write_text(page(proposal), encoding="utf-8")


def page(proposal: Proposal) -> str:
    """The page: the shots from the side and from above, the guesses, and omitted rows."""
    info = proposal.info
    samples = sum(len(track) for track in proposal.tracks)
    bounce = "" if info.table_height is None else " and bounce on the grey line"
    words = (
        f"{counted(len(proposal.tracks), 'shot')}, {counted(samples, 'sample')}, {info.rate:g} Hz, from {info.source}. "
        f"Balls fly in arcs that open downwards{bounce} if the import is right."
    )
    rows = (
        (guess.what, tag("b", guess.value), guess.why, tag("span", guess.sure, kind=guess.sure), typed(guess.option))
        for guess in proposal.guesses
    )
    return whole_page(
        f"{info.name}: import",
        tag("h1", info.name),
        tag("p", words),
        doubtful(info.doubts),
        tag("figure", _drawing(proposal.tracks, info.table_height), kind="drawing"),
        section("Guesses", table(("what", "guess", "why", "how sure", "change it with"), rows)),
        section("Left out or repaired", items(proposal.notes)),
    )


def _drawing(tracks: Sequence[Track], height: float | None) -> Html:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    # the horizontal axis of the longer flights
    across = int(np.argmax(np.median([np.ptp(track.positions[:, :2], axis=0) for track in tracks], axis=0)))
    with mpl.rc_context({"svg.hashsalt": "ballfg", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(9.0, 6.5), layout="constrained")
        side, above = figure.subplots(2, 1)
        for track in tracks[:: max(1, -(-len(tracks) // _MOST_SHOTS))]:
            p = track.positions[:: max(1, -(-len(track) // _MOST_POINTS))]
            for axes, other in ((side, 2), (above, 1 - across)):
                axes.plot(p[:, across], p[:, other], ".-", markersize=2, linewidth=0.5, alpha=0.7)
        if height is not None:
            side.axhline(height, color="0.5", linewidth=1.5)
        names = "xyz"
        side.set(ylabel="z, m (up)", title="from the side")
        above.set(xlabel=f"{names[across]}, m", ylabel=f"{names[1 - across]}, m", title="from above")
        for axes in (side, above):
            axes.set_aspect("equal", adjustable="datalim")
        text = io.StringIO()
        metadata: dict[str, Any] = {"Date": None, "Creator": None}
        figure.savefig(text, format="svg", metadata=metadata)
    return Html(text.getvalue()[text.getvalue().index("<svg") :])


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
        length: unit of positions, and of sigmas whose names state no other one: m, cm, mm, in or ft.
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
