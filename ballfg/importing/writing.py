"""An import as a folder: the dataset, and `import.html`, a page that shows what was understood."""

import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.importing.proposal import Proposal
from ballfg.tracks import Track, write_dataset
from ballfg.tracks.info import INFO_FILE
from ballfg.tracks.writing import DATASET_FILES

PAGE: Final = "import.html"
_MOST_SHOTS: Final = 40
"""Shots that are drawn, evenly over the dataset."""
_MOST_POINTS: Final = 300
"""Samples of a shot that are drawn."""
_STYLE: Final = """
body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;width:100%}
td,th{text-align:left;padding:.3rem .6rem;border-bottom:1px solid #ddd;vertical-align:top}
code{background:#f3f3f3;padding:.1rem .3rem}svg{width:100%;height:auto}.unsure{color:#b00020}.likely{color:#8a5a00}
@media(prefers-color-scheme:dark){
body{background:#181818;color:#ddd}td,th{border-color:#444}code{background:#2a2a2a}svg{background:#fff}
.unsure{color:#ff8080}.likely{color:#e0b060}}
"""


def write_import(folder: Path, proposal: Proposal, file_format: Literal["csv", "parquet"], force: bool) -> None:
    """Writes the dataset and its page as a whole, or nothing.

    Args: folder: new, empty, or with `force` a dataset to replace.  proposal: to write.  file_format: of the tracks.
    Raises: ValueError: a folder with other content. FileNotFoundError: its parent does not exist.
    """
    check_replaceable(folder, mark=INFO_FILE, what="a dataset", force=force)
    with whole_folder(folder, earlier=(*DATASET_FILES, PAGE)) as stage:
        write_dataset(stage, proposal.info, proposal.tracks, file_format)
        (stage / PAGE).write_text(page(proposal), encoding="utf-8")


def page(proposal: Proposal) -> str:
    """The page: the shots from the side and from above, the guesses, and what was left out."""
    info = proposal.info
    rows = "".join(
        f"<tr><td>{_safe(guess.what)}</td><td><b>{_safe(guess.value)}</b></td><td>{_safe(guess.why)}</td>"
        f'<td class="{_safe(guess.sure)}">{_safe(guess.sure)}</td><td><code>{_safe(guess.option)}</code></td></tr>'
        for guess in proposal.guesses
    )
    notes = "".join(f"<li>{_safe(note)}</li>" for note in proposal.notes)
    samples = sum(len(track) for track in proposal.tracks)
    left = f"<h2>Left out or repaired</h2><ul>{notes}</ul>" if notes else ""
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{_safe(info.name)}: import</title>'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head><body>'
        f"<h1>{_safe(info.name)}</h1><p>{len(proposal.tracks)} shots, {samples} samples, {info.rate:g} Hz, from "
        f"{_safe(info.source)}. Balls fly in arcs that open downwards and bounce on the grey line if the import is "
        f"right.</p>{_picture(proposal.tracks, info.table_height)}<h2>Guesses</h2><table><tr><th>what</th>"
        f"<th>guess</th><th>why</th><th>how sure</th><th>change it with</th></tr>{rows}</table>{left}</body></html>\n"
    )


def _safe(text: object) -> str:
    return html.escape(str(text))


def _picture(tracks: Sequence[Track], height: float) -> str:
    """The shots from the side and from above, as SVG."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    across = _across(tracks)
    with mpl.rc_context({"svg.hashsalt": "ballfg", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(9.0, 6.5), layout="constrained")
        side, above = figure.subplots(2, 1)
        for track in tracks[:: max(1, -(-len(tracks) // _MOST_SHOTS))]:
            p = track.positions[:: max(1, -(-len(track) // _MOST_POINTS))]
            for axes, other in ((side, 2), (above, 1 - across)):
                axes.plot(p[:, across], p[:, other], ".-", markersize=2, linewidth=0.5, alpha=0.7)
        side.axhline(height, color="0.5", linewidth=1.5)
        names = "xyz"
        side.set(ylabel="z, m (up)", title="from the side")
        above.set(xlabel=f"{names[across]}, m", ylabel=f"{names[1 - across]}, m", title="from above")
        for axes in (side, above):
            axes.set_aspect("equal", adjustable="datalim")
        text = io.StringIO()
        metadata: dict[str, Any] = {"Date": None, "Creator": None}
        figure.savefig(text, format="svg", metadata=metadata)
    return text.getvalue()[text.getvalue().index("<svg") :]


def _across(tracks: Sequence[Track]) -> int:
    """The horizontal axis along which the balls fly farther."""
    extents = np.median([np.ptp(track.positions[:, :2], axis=0) for track in tracks], axis=0)
    return int(np.argmax(extents))
