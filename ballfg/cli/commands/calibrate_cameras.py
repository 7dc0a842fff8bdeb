"""Implements `ballfg calibrate-cameras`: images of a board and points of the table give `cameras.yaml`."""

import json
import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from ballfg.progress import progress

if TYPE_CHECKING:
    from ballfg.vision.arrays import Image
    from ballfg.vision.calibration.boards import Board
    from ballfg.vision.calibration.intrinsics import Intrinsics
    from ballfg.vision.calibration.report import Calibration
    from ballfg.vision.calibration.table_points import TableFile
    from ballfg.vision.camera import Camera

OURS: Final = (".yaml", ".yml")
THEIRS: Final = (".xml", ".json")  # Endings of camera files: this package's, and those of OpenCV's FileStorage

_lens_option, _place_option = (
    partial(typer.Option, rich_help_panel=panel) for panel in ("Lens, from images of a board", "Place, from the table")
)


def calibrate_cameras(
    out: Annotated[Path, typer.Option(help="Output camera file: .yaml, or .xml or .json for OpenCV.")],
    images: Annotated[
        list[str] | None,
        _lens_option(help="Board images of a camera, NAME=PLACE: a folder, pattern or file; may be repeated."),
    ] = None,
    board: Annotated[Literal["chessboard", "charuco"], _lens_option(help="Kind of board.")] = "chessboard",
    squares: Annotated[str, _lens_option(help="Number of squares, columns x rows, with the outermost: 10x7.")] = "",
    square: Annotated[float, _lens_option(help="Side of a square, m.")] = 0.0,
    marker: Annotated[float, _lens_option(help="Side of a ChArUco marker, m.")] = 0.0,
    dictionary: Annotated[str, _lens_option(help="ArUco dictionary of the markers.")] = "4X4_100",
    legacy: Annotated[bool, _lens_option("--legacy", help="Board printed by OpenCV before 4.6.")] = False,
    distortion: Annotated[int, _lens_option(help="Number of distortion coefficients: 0, 4, 5, 8, 12 or 14.")] = 5,
    intrinsics: Annotated[
        Path | None, typer.Option(help="Camera file with known lenses, in place of --images.")
    ] = None,
    table: Annotated[Path | None, _place_option(help="File with pixels of the table's corners by camera.")] = None,
    focal_sigma: Annotated[
        float | None,
        _place_option(
            help="Relative standard deviation of focal lengths that are known roughly; they are then found with the "
            "place, and OUT states how well."
        ),
    ] = None,
    view: Annotated[
        list[str] | None, _place_option(help="Image of a camera for the drawn table, NAME=IMAGE; may be repeated.")
    ] = None,
) -> None:
    """Calibrate each camera's lens from images of a board, and its pose from the corners of the table.

    Example: ballfg calibrate-cameras --squares 10x7 --square 0.025 --images left=calib/left --images
    right=calib/right --table table.yaml --out cameras.yaml

    OUT_calibration.json and .png show how accurate the calibration is. Without --table only the lenses are written, for
    a later --intrinsics.
    """
    from ballfg.checks import check_range
    from ballfg.files.whole_file import check_file
    from ballfg.vision.calibration.boards import read_grey
    from ballfg.vision.calibration.focal import ROUGHLY
    from ballfg.vision.calibration.table_points import read_table
    from ballfg.vision.camera_file import read_cameras

    if out.suffix.lower() not in (*OURS, *THEIRS):
        raise ValueError(f"out must end in {', '.join((*OURS, *THEIRS))}; got {out}. Choose the format by the ending.")
    check_file(out)
    if out.exists() and not _holds_cameras(out):
        raise ValueError(f"out must be new or a file of cameras; {out} holds something else. Choose another name.")
    if (intrinsics is None) == (images is None):
        raise ValueError("either --images or --intrinsics must be given, and not both. Lenses come from one of them.")
    if intrinsics is not None and table is None:
        raise ValueError("--intrinsics must come with --table; got no --table. Without it there is nothing to find.")
    if focal_sigma is not None:
        check_range("--focal-sigma", focal_sigma, *ROUGHLY)
        if table is None or out.suffix.lower() not in OURS:
            raise ValueError(
                f"--focal-sigma must come with --table and with an --out of {' or '.join(OURS)}. Give both."
            )
    places = _grouped("images", images or ())
    shown = {name: read_grey(Path(paths[-1])) for name, paths in _grouped("view", view or ()).items()}
    marked = None if table is None else read_table(table)
    if intrinsics is not None:
        lenses = {camera.name: camera for camera in read_cameras(intrinsics, posed=False)}
        _check_same(lenses, str(intrinsics), marked, table, shown)
        found = [_placed(camera, None, marked, focal_sigma) for camera in lenses.values()]
    else:
        _check_same(places, "--images", marked, table, shown)
        pattern = _board(board, squares, square, marker, dictionary, legacy)
        fitted = [_lens(name, where, pattern, distortion) for name, where in places.items()]
        found = [_placed(lens.camera, lens, marked, focal_sigma) for lens in fitted]
    _write(out, found, shown, marked)


def _grouped(option: str, words: Iterable[str]) -> dict[str, list[str]]:
    """Paths by camera. Raises: ValueError: an argument other than NAME=PLACE."""
    grouped: dict[str, list[str]] = {}
    for word in words:
        name, equals, place = word.partition("=")
        if not (name and equals and place):
            raise ValueError(f"--{option} must be NAME=PLACE, as left=calib/left; got {word!r}. Name the camera.")
        grouped.setdefault(name, []).append(place)
    return grouped


def _check_same(
    cameras: Iterable[str], where: str, marked: "TableFile | None", table: Path | None, shown: Iterable[str]
) -> None:
    """Refuses a camera that is named in only one of the two."""
    cameras = set(cameras)
    listed = ", ".join(sorted(cameras))
    for name in sorted(set(shown) - cameras):
        raise ValueError(f"--view names camera {name!r}, which {where} does not ({listed}). Rename it.")
    if marked is None:
        return
    for name in sorted(cameras ^ set(marked.cameras)):
        here, there = (where, table) if name in cameras else (table, where)
        raise ValueError(f"{here} names camera {name!r}, which {there} does not. Add it there, or leave it out.")


def _board(kind: str, squares: str, square: float, marker: float, dictionary: str, legacy: bool) -> "Board":
    from ballfg.vision.calibration.boards import Charuco, Chessboard

    match = re.fullmatch(r"(\d+)x(\d+)", squares)
    if match is None:
        raise ValueError(f"--squares must be squares in a row x rows, as 10x7; got {squares!r}. Count them.")
    columns, rows = int(match[1]), int(match[2])
    if kind == "chessboard":
        return Chessboard(columns, rows, square)
    return Charuco(columns, rows, square, marker, dictionary.upper().removeprefix("DICT_"), legacy)


def _lens(name: str, places: Iterable[str], board: "Board", distortion: int) -> "Intrinsics":
    from ballfg.vision.calibration.boards import find_views, image_files, suggested
    from ballfg.vision.calibration.intrinsics import calibrate_intrinsics

    files = image_files(places)
    views = list(progress(find_views(files, board), len(files), f"images of {name} searched"))
    if not any(len(one.pixels) for one in views):
        hint = suggested(files, board)
        if hint:
            raise ValueError(f"camera {name!r}: --squares must be those of the board; got another number.{hint}")
    return calibrate_intrinsics(name, views, distortion)


def _placed(
    camera: "Camera", lens: "Intrinsics | None", marked: "TableFile | None", focal_sigma: float | None
) -> "Calibration":
    import numpy as np

    from ballfg.vision.calibration.extrinsics import calibrate_extrinsics
    from ballfg.vision.calibration.focal import ROUGHLY, pose_and_focal
    from ballfg.vision.calibration.report import Calibration

    if marked is None:
        return Calibration(camera, lens, None)
    points = marked.cameras[camera.name]
    if focal_sigma is None and camera.covariance is not None:  # found with an earlier place, as well as it says
        focal_sigma = float(np.clip(np.sqrt(camera.covariance[-1, -1]), *ROUGHLY))
    place = calibrate_extrinsics(camera, points) if focal_sigma is None else pose_and_focal(camera, points, focal_sigma)
    return Calibration(place.camera, lens, place)


def _holds_cameras(path: Path) -> bool:
    from ballfg.vision.camera_file import read_cameras

    try:
        return bool(read_cameras(path, posed=False))
    except (ValueError, TypeError):
        return False


def _write(out: Path, found: "list[Calibration]", shown: "Mapping[str, Image]", marked: "TableFile | None") -> None:
    from ballfg.files.whole_file import whole_file
    from ballfg.vision.calibration.report import calibration_picture, content, summary
    from ballfg.vision.calibration.table_points import TABLE_HEIGHT
    from ballfg.vision.camera_file import write_cameras, write_opencv

    figure = calibration_picture(found, shown, TABLE_HEIGHT if marked is None else marked.table_height)
    report, picture = (out.with_name(f"{out.stem}_calibration{ending}") for ending in (".json", ".png"))
    text = json.dumps([content(one) for one in found], indent=2, allow_nan=False, ensure_ascii=False)
    write = write_cameras if out.suffix.lower() in OURS else write_opencv
    with whole_file(report) as first, whole_file(picture) as second, whole_file(out) as third:
        first.write_text(text + "\n", encoding="utf-8")
        figure.savefig(second)
        write(third, [one.camera for one in found], posed=marked is not None)
        for old in (report, picture):  # they never lie beside cameras of another calibration
            old.unlink(missing_ok=True)
    print(*(line for one in found for line in summary(one)), sep="\n")
    print(f"{out}: {len(found)} camera{'s' if len(found) > 1 else ''}{'' if marked else ', lenses only'}")
    print(f"how well they are known: {report}, {picture}")
