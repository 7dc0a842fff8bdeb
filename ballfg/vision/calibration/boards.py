"""Finds the corners of calibration boards, chessboard and ChArUco, in images."""

import glob
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.vision.arrays import Image
from ballfg.vision.image_file import ENDINGS, read_image

MIN_CORNERS: Final = 8  # least number of corners in a view: a homography needs 4, and twice as many reveal a wrong one
DICTIONARIES: Final = tuple(sorted(n.removeprefix("DICT_") for n in dir(cv2.aruco) if n.startswith("DICT_")))
"""Names of ArUco's dictionaries, without `DICT_`."""
_SEARCH: Final = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
_REFINE: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
_WINDOW: Final = 0.25  # half the refinement's window, as a share of the distance to the next corner
_WINDOW_LIMITS: Final = (2, 8)  # px: a smaller half window sees no edges, a larger one sees the lens bend them
_IN_SQUARE: Final = 0.3  # distance from a corner at which its four squares are sampled, as a share of a side
_UNLIKE: Final = 0.5  # share of the contrast by which two squares that touch at a corner only may differ
_TRIED: Final = 3  # images without a board in which other numbers of squares are tried: each costs up to a second


@dataclass(frozen=True)
class _Squares:
    least: ClassVar[int]  # fewest squares in a row and in a column
    columns: int  # squares in a row, the outermost ones too: one more than there are inner corners
    rows: int  # rows of squares
    square: float  # m, side of a square

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < self.least:
            problem = f"squares must be at least {self.least} a row and column; got {self.columns}x{self.rows}"
            raise ValueError(f"{problem}. Count all squares, the outermost ones too.")
        if not 0.0 < self.square < np.inf:
            raise ValueError(f"square must be the side of a square in m, above 0; got {self.square:g}. Measure it.")


@dataclass(frozen=True)
class Chessboard(_Squares):
    """A chessboard. Raises: ValueError: fewer than 4 squares in a row or column, or no positive size."""

    least: ClassVar[int] = 4

    def find(self, image: Image) -> tuple[Array, Array] | None:
        """Pixels (n, 2) and points (n, 3) m on the board of the inner corners in a grey image; None if not all show."""
        across, down = self.columns - 1, self.rows - 1
        found, corners = cv2.findChessboardCornersSB(image, (across, down), flags=_SEARCH)
        if not found:
            return None
        grid = np.asarray(corners, dtype=np.float32).reshape(down, across, 2)
        if not _where_squares_meet(image, grid):
            return None
        pixels = _refined(image, grid)
        places = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2)
        return pixels, np.column_stack((self.square * places, np.zeros(len(places))))


@dataclass(frozen=True)
class Charuco(_Squares):
    """A chessboard with an ArUco marker in each white square; it may be seen in part.

    Raises: ValueError: fewer than 3 squares in a row or column, a marker not smaller than a square, a dictionary that
        there is not or that has too few markers.
    """

    least: ClassVar[int] = 3

    marker: float  # m, side of a marker
    dictionary: str = "4X4_100"  # one of `DICTIONARIES`
    legacy: bool = False  # printed by OpenCV before 4.6, which began boards with an even number of rows with a marker

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.marker < self.square:
            problem = f"marker must be above 0 and smaller than a square of {self.square:g} m; got {self.marker:g}"
            raise ValueError(f"{problem}. Measure both on the print.")
        if self.dictionary not in DICTIONARIES:
            known = ", ".join(DICTIONARIES)
            raise ValueError(f"dictionary must be one of {known}; got {shown(self.dictionary)}. Choose one.")
        needed, there = self.columns * self.rows // 2, len(_dictionary(self.dictionary).bytesList)
        if there < needed:
            raise ValueError(
                f"dictionary must have {needed} markers for {self.columns}x{self.rows} squares; "
                f"{self.dictionary} has {there}. Give the one that the board was printed with."
            )

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board."""
        sides, words = (self.columns, self.rows), _dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(sides, self.square, self.marker, words)
        board.setLegacyPattern(self.legacy)
        return board

    def find(self, image: Image) -> tuple[Array, Array] | None:
        """Pixels (n, 2) and points (n, 3) m on the board of the corners in a grey image; None if hardly any show."""
        corners, ids, _, _ = cv2.aruco.CharucoDetector(self.board).detectBoard(image)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        points = np.asarray(self.board.getChessboardCorners(), dtype=np.float64)[np.ravel(ids)]
        if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=1e-3 * self.square) < 2:
            return None
        return np.asarray(corners, dtype=np.float64).reshape(-1, 2), points


Board: TypeAlias = Chessboard | Charuco


@dataclass(frozen=True, eq=False)
class View:
    """The corners of a board in one image."""

    name: str  # name of the image's file
    size: tuple[int, int]  # px, width and height of the image
    pixels: Array  # (n, 2) px, corners in the image; n is 0 where no board was found
    points: Array  # (n, 3) m, the same corners on the board, z = 0


def image_files(places: Iterable[str]) -> list[Path]:
    """The images in folders, of patterns such as `left_*.png`, or single ones. Raises: FileNotFoundError: none."""
    files: list[Path] = []
    for place in places:
        path = Path(place)
        found = sorted(path.iterdir()) if path.is_dir() else sorted(map(Path, glob.glob(place))) or [path]
        images = [file for file in found if file.is_file() and file.suffix.lower() in ENDINGS]
        if not images:
            what = f"{place}: must be a folder, a pattern or a file of images ({', '.join(ENDINGS)})"
            raise FileNotFoundError(f"{what}. Correct it.")
        files += images
    return files


def read_grey(path: Path) -> Image:
    """A grey image (h, w) as the sensor saw it, whatever its orientation note. Raises: ValueError: not an image."""
    return read_image(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def find_views(files: Iterable[Path], board: Board) -> Iterator[View]:
    """A view of each image, one by one. Raises: ValueError: an image that cannot be read."""
    for file in files:
        image = read_grey(file)
        pixels, points = board.find(image) or (np.zeros((0, 2)), np.zeros((0, 3)))
        yield View(file.name, (image.shape[1], image.shape[0]), pixels, points)


def suggested(files: Sequence[Path], board: Board) -> str:
    """A suggestion for images without a found board: another number of squares; empty without one."""
    for more in (1, -1):
        if min(board.columns, board.rows) + more < board.least:
            continue
        other = replace(board, columns=board.columns + more, rows=board.rows + more)
        if any(len(view.pixels) for view in find_views(files[:_TRIED], other)):
            squares = f" The images show {other.columns}x{other.rows} squares"
            return f"{squares}: squares are counted with the outermost ones, not the corners between them."
    return ""


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _where_squares_meet(image: Image, grid: Array | NDArray[np.float32]) -> bool:
    """True if at every corner two dark and two light squares meet, with equal ones opposite.

    Where a row of the board lies outside the image, OpenCV's search takes the board's edge for it.
    """
    along, down = np.gradient(grid.astype(np.float64), axis=(1, 0))
    offsets = [_IN_SQUARE * (i * along + j * down) for i, j in ((1, 1), (-1, -1), (1, -1), (-1, 1))]
    u, v = np.concatenate([grid + offset for offset in offsets]).astype(np.float32).transpose(2, 0, 1)
    grey = cv2.remap(image.astype(np.float32), u.copy(), v.copy(), cv2.INTER_LINEAR)
    one, same, other, like_other = np.asarray(grey, dtype=np.float64).reshape(4, *grid.shape[:2])
    contrast = np.abs(one + same - other - like_other) / 2.0
    return bool((np.maximum(np.abs(one - same), np.abs(other - like_other)) < _UNLIKE * contrast).all())


def _refined(image: Image, grid: NDArray[np.float32]) -> Array:
    """(n, 2) corners of a grid (down, across, 2), moved to where the gradients around them meet."""
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(_WINDOW * min(sides), *_WINDOW_LIMITS))
    corners = np.ascontiguousarray(grid.reshape(-1, 1, 2))
    corners = np.asarray(cv2.cornerSubPix(image, corners, (half, half), (-1, -1), _REFINE))
    return corners.reshape(-1, 2).astype(np.float64)
