"""Writes an import as a folder: the dataset, and the page `import.html` with all guesses."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.importing.proposal import Proposal
from ballfg.pages.html import Html, doubtful, items, section, table, tag, typed
from ballfg.pages.page import whole_page
from ballfg.tracks import Track, write_dataset
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
        f"{len(proposal.tracks)} shots, {samples} samples, {info.rate:g} Hz, from {info.source}. "
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
