"""Implements `ballfg show`, which writes a page of shots, estimates, predictions and a diagnosis."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.files.whole_file import check_file, whole_file, write_text
from ballfg.progress import counted, print_doubts, print_notes

if TYPE_CHECKING:
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.pages.shown import Shown
    from ballfg.tracks import Dataset


def show(
    given: Annotated[
        list[Path],
        typer.Argument(
            metavar="WHAT...",
            help="Dataset, states of estimate, predictions of predict, folder or report.json of diagnose, video of a "
            "rally; one or more, in any order.",
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Page to write, .html.")] = None,
    png: Annotated[Path | None, typer.Option(help="Picture for papers, .png, .pdf or .svg, of the first shot.")] = None,
    rerun: Annotated[
        Path | None, typer.Option(help="Recording .rrd for the viewer rerun, of all shots however long.")
    ] = None,
    track: Annotated[
        list[str] | None, typer.Option(help="Name of a shot to show; may be repeated. Default: the first 40.")
    ] = None,
) -> None:
    """A page with each shot over the table, its residuals, its predictions against what was measured.

    Example: ballfg show data/ballgun states.csv predictions.csv --out page.html

    Example: ballfg show rally rally.mp4 --out rally.html

    Of a rally (`ballfg track` of one moving camera) the page shows the video with its flights beside the table.

    The page is one file: it opens without a network, on a computer or a phone. A large video stays beside it.
    """
    from ballfg.pages.given import recognise
    from ballfg.pages.show_page import show_page
    from ballfg.pages.shown import collect

    _check_outputs(out, png, rerun)
    if out is not None and (rally := _rally(given)) is not None:
        beside = {"--png": png, "--rerun": rerun, "--track": track}
        if others := [option for option, value in beside.items() if value]:
            raise ValueError(f"the page of a rally must be asked for alone; got {', '.join(others)}. Leave it out.")
        from ballfg.estimation.rally.page import rally_page

        page, notes = rally_page(*rally, out)
        print_notes(notes)
        write_text(out, page)
        print(f"{out}: the rally of {rally[0]}")
        return
    what, names = recognise(given, _dataset), track or []
    print_doubts(what.dataset.info.doubts if what.dataset is not None else ())
    print_notes(what.dataset.notes if what.dataset is not None else ())
    if rerun is not None:
        from ballfg.pages.recording import record

        all_shots = collect(what, names, limited=False)
        with whole_file(rerun, "rerun") as temporary:
            record(all_shots, temporary)
        print(f"{rerun}: {counted(len(all_shots.shots), 'shot')}")
    if out is None and png is None:
        return
    shown = collect(what, names)
    print_notes(shown.notes)
    if png is not None:
        _write_picture(shown, png)
    if out is not None:
        write_text(out, show_page(shown))
        print(f"{out}: {len(shown.shots)} of {shown.count} shots")


def _rally(given: list[Path]) -> tuple[Path, Path | None] | None:
    """The folder of a rally and its video, if these are what is given."""
    from ballfg.vision.broadcast.files import VIDEOS, is_rally  # light: most pages are of no rally

    videos = [path for path in given if path.suffix.lower() in VIDEOS]
    folders = [path for path in given if path not in videos]
    if len(folders) != 1 or len(videos) > 1 or not is_rally(folders[0]):
        return None
    return folders[0], videos[0] if videos else None


def _dataset(folder: Path) -> "Dataset | SightedDataset":
    """The tracks of a folder; roughly triangulated ones if there are only detections."""
    from ballfg.tracks.dataset import has_positions, read_dataset

    if has_positions(folder):
        return read_dataset(folder)  # without torch, which takes seconds to load
    from ballfg.estimation import read_sighted

    return read_sighted(folder)


def _check_outputs(out: Path | None, png: Path | None, rerun: Path | None) -> None:
    """Refuses outputs that cannot be written, before anything is read. Raises: ValueError."""
    if out is None and png is None and rerun is None:
        raise ValueError("out must name the page to write; got nothing. Add --out page.html, --png or --rerun.")
    for name, path, endings in (
        ("out", out, (".html", ".htm")),
        ("png", png, (".png", ".pdf", ".svg")),
        ("rerun", rerun, (".rrd",)),
    ):
        if path is not None:
            if path.suffix.lower() not in endings:
                raise ValueError(f"{name} must end in {' or '.join(endings)}; got {path}. Choose another name.")
            check_file(path, name)
    if rerun is not None:
        from ballfg.pages.recording import check_rerun

        check_rerun()


def _write_picture(shown: "Shown", png: Path) -> None:
    from ballfg.pages.pictures import views

    if not shown.shots:
        raise ValueError("png must have a shot to draw; only a diagnosis was given. Add a dataset or a table.")
    with whole_file(png, "png") as temporary:
        views(shown.shots[0], shown.table).savefig(temporary, dpi=200)
    print(f"{png}: shot {shown.shots[0].name}")
