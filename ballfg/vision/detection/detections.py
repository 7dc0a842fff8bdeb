"""Holds the candidates of a frame and of a recording, reads them from tables, and defines a detector."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array, Index, Mask
from ballfg.checks import check_array, shown
from ballfg.tracks import detections_file
from ballfg.tracks.checks import check_step
from ballfg.tracks.rows import KEY
from ballfg.tracks.sightings import are_covariances
from ballfg.vision.arrays import Image
from ballfg.vision.camera import Camera

_SHAPES: Final = {"pixels": (2,), "covariances": (2, 2), "scores": (), "streaks": (2, 2), "radii": (2,)}  # of each
UNKNOWN_RADIUS: Final = (0.0, 1.0)  # px, in place of a radius and its standard deviation
UNSIZED: Final = np.zeros((0, 2))  # in place of radii: all unknown


@dataclass(frozen=True, eq=False)
class Candidates:
    """Possible balls in one frame: k candidates, in any order. Arrays are copied, converted and checked.

    Raises: ValueError: a wrong shape, a pixel that is not finite, a covariance that is not positive definite, a score
        outside [0, 1]; the message names the field and the candidate.
    """

    pixels: Array
    """(k, 2) px, the ball's centre in mid exposure; (0, 0) is the centre of the top left pixel."""
    covariances: Array
    """(k, 2, 2) px^2."""
    scores: Array
    """(k,) dimensionless, in [0, 1], similarity to a ball."""
    streaks: Array
    """(k, 2, 2) px, centre at the shutter's opening and closing, in unknown order; NaN where not blurred."""
    radii: Array = field(default_factory=UNSIZED.copy)
    """(k, 2) px, radius in the picture, 0 where unknown, and its standard deviation; by default all unknown."""

    def __post_init__(self) -> None:
        _check_fields(self, "candidates")

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def none(cls) -> Self:
        """The candidates of a frame without any."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros((0, 2, 2)))

    @classmethod
    def at(cls, pixels: ArrayLike, sigma: float, scores: ArrayLike | None = None) -> Self:
        """The candidates of a detector that gives centres only.

        Args: pixels: (k, 2).  sigma: px, of each coordinate.  scores: (k,) dimensionless, in [0, 1]; 1 by default.
        """
        centres = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        count = len(centres)
        marks = np.ones(count) if scores is None else np.asarray(scores, dtype=np.float64)
        return cls(centres, np.tile(sigma**2 * np.eye(2), (count, 1, 1)), marks, np.full((count, 2, 2), np.nan))


Detector = Callable[[Image], Candidates]
"""Any callable from an image (h, w, 3) in BGR to its candidates. It may remember earlier frames: it is called once a
frame, in their order, and serves one camera only."""


@dataclass(frozen=True, eq=False)
class Detections:
    """All candidates of one camera over a recording, good and bad ones. Arrays are copied, converted and checked.

    Raises: ValueError: as `Candidates`; stamps that do not increase, or frame numbers that are out of order or range.
        TypeError: a name that is not text.
    """

    camera: str
    """Name of the camera."""
    frames: Array
    """(f,) s, recorded stamps of all frames, strictly increasing."""
    frame: Index
    """(n,) number of each candidate's frame, not decreasing."""
    pixels: Array
    """(n, 2) px, the ball's centre in mid exposure; (0, 0) is the centre of the top left pixel."""
    covariances: Array
    """(n, 2, 2) px^2."""
    scores: Array
    """(n,) dimensionless, in [0, 1], similarity to a ball."""
    streaks: Array
    """(n, 2, 2) px, centre at the shutter's opening and closing, in unknown order; NaN where not blurred."""
    shifts: Array | None = None
    """(f, 3) m, where the camera stood in each frame, from its own place; None: it did not move."""
    radii: Array = field(default_factory=UNSIZED.copy)
    """(n, 2) px, radius in the picture, 0 where unknown, and its standard deviation; by default all unknown."""

    def __post_init__(self) -> None:
        if not isinstance(self.camera, str):
            raise TypeError(f"camera must be a name; got {shown(self.camera)}. Put it in quotes.")
        what = f"detections of camera {shown(self.camera)}"
        stamps = _numbers(what, "frames", self.frames, (np.asarray(self.frames).size,))
        object.__setattr__(self, "frames", stamps)
        wrong = np.flatnonzero(~(np.diff(stamps) > 0.0))
        if len(wrong):
            i = int(wrong[0]) + 1
            problem = f"{what}: frames must be strictly increasing; frames[{i}]={stamps[i]} after {stamps[i - 1]}"
            raise ValueError(f"{problem}. Sort the frames or correct the stamps.")
        if not np.isfinite(stamps).all():
            raise ValueError(f"{what}: frames must be finite; got {stamps[~np.isfinite(stamps)][0]}.")
        _check_fields(self, what)
        if self.shifts is not None:
            object.__setattr__(self, "shifts", _numbers(what, "shifts", self.shifts, (len(stamps), 3)))
            _refuse(np.asarray(~np.isfinite(self.shifts).all(axis=1)), what, "shifts", "be finite")
        frame = np.array(self.frame, dtype=np.int64)
        if frame.shape != (len(self.pixels),):
            raise ValueError(f"{what}: frame must have shape ({len(self.pixels)},); got {frame.shape}.")
        if len(frame) and not (frame[0] >= 0 and frame[-1] < len(self.frames) and (np.diff(frame) >= 0).all()):
            rule = f"{what}: frame must be numbers from 0 to {len(self.frames) - 1} in order"
            raise ValueError(f"{rule}; got {frame.tolist()[:8]}. Sort the candidates by frame.")
        frame.setflags(write=False)
        object.__setattr__(self, "frame", frame)

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def times(self) -> Array:
        """(n,) s, the recorded stamp of each candidate."""
        return np.asarray(self.frames[self.frame])

    @property
    def shift(self) -> Array | None:
        """(n, 3) m, where the camera stood as it saw each candidate, from its own place; None: it did not move."""
        return None if self.shifts is None else self.shifts[self.frame]

    def radii_of(self, rows: Index) -> Array | None:
        """(k, 2) px, radii of some candidates and their standard deviations; None if all are unknown.

        Args: rows: (k,) numbers of the candidates.
        """
        return self.radii[rows] if (self.radii[rows, 0] > 0.0).any() else None

    def in_frame(self, number: int) -> Candidates:
        """The candidates of one frame."""
        rows = slice(*np.searchsorted(self.frame, (number, number + 1)))
        return Candidates(*(getattr(self, name)[rows] for name in _SHAPES))

    def select(self, keep: Mask) -> Self:
        """The detections with the candidates of `keep` (n,) bool, and all frames."""
        return replace(self, **{name: getattr(self, name)[keep] for name in ("frame", *_SHAPES)})

    def best_scores(self, count: int = 3) -> Array:
        """(k,) dimensionless, the highest scores, best first, with k at most `count`."""
        return np.sort(self.scores)[::-1][:count].copy()

    @classmethod
    def of_frames(cls, camera: str, seen: Iterable[tuple[float, Candidates]]) -> Self:
        """Joins the candidates of frames.

        Args: camera: name of the camera.  seen: stamp (s) and candidates of each frame, in order.
        Raises: ValueError: stamps that do not increase.
        """
        pairs = list(seen)
        stamps, found = [stamp for stamp, _ in pairs], [Candidates.none(), *(candidates for _, candidates in pairs)]
        return cls(
            camera,
            np.array(stamps, dtype=np.float64),
            np.repeat(np.arange(len(stamps)), [len(candidates) for candidates in found[1:]]),
            **{name: np.concatenate([getattr(candidates, name) for candidates in found]) for name in _SHAPES},
        )


def _numbers(what: str, name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = check_array(f"{what}: {name}", value, shape, "Pass one row per candidate.")
    array.setflags(write=False)
    return array


def _check_fields(owner: Candidates | Detections, what: str) -> None:
    """Checks the fields that candidates of a frame and of a recording share."""
    count = len(np.asarray(owner.pixels))
    if len(owner.radii) == 0:
        object.__setattr__(owner, "radii", np.tile(UNKNOWN_RADIUS, (count, 1)))
    for name, shape in _SHAPES.items():
        object.__setattr__(owner, name, _numbers(what, name, getattr(owner, name), (count, *shape)))
    for name in ("pixels", "covariances", "scores", "radii"):
        finite = np.isfinite(getattr(owner, name))
        _refuse(~finite.all(axis=tuple(range(1, finite.ndim))), what, name, "be finite")
    _refuse(~are_covariances(owner.covariances), what, "covariances", "be symmetric and positive definite")
    _refuse((owner.scores < 0.0) | (owner.scores > 1.0), what, "scores", "lie in [0, 1]")
    _refuse((owner.radii[:, 0] < 0.0) | (owner.radii[:, 1] <= 0.0), what, "radii", "be a radius and a sigma above zero")


def _refuse(wrong: Mask, what: str, name: str, rule: str) -> None:
    if wrong.any():
        raise ValueError(f"{what}: {name} must {rule}; those of candidate {int(np.argmax(wrong))} do not.")


REQUIRED: Final = ("t", detections_file.CAMERA, "u", "v")
UNUSED: Final = (KEY,)  # columns that may be there and are not needed: which ball a row belongs to is found anew


def read_detections(
    path: Path, cameras: Sequence[Camera], ignored: Sequence[str] = ()
) -> tuple[list[Detections], list[str]]:
    """The candidates of each camera.

    A camera's frames are the stamps at which it has a row: rows at one stamp are candidates of one frame. The order of
    rows is free.

    Args:
        path: `t` (s, as the camera writes it), `camera`, `u`, `v` (px), optionally `sigma_u`, `sigma_v` (px), `rho_uv`,
            `radius` and `sigma_radius` (px), `score`, and the columns `SHIFT` (m).
        ignored: names of cameras whose rows are passed over.
    Returns: detections in the order of the cameras, and what was ignored, one sentence each.
    Raises: FileNotFoundError: there is no such file. ValueError: a column that is missing, a cell out of its range, an
        unknown camera, a camera without rows; the message names file, line and column.
    """
    header, texts, values = detections_file.read_candidates(path, REQUIRED)
    names = texts[detections_file.CAMERA]
    rows = np.arange(len(names))
    detections_file.check_cameras(path, names, rows, [camera.name for camera in cameras], ignored)
    blind = [camera.name for camera in cameras if not (names == camera.name).any()]
    if blind:
        problem = f"{path}: every camera must have rows; got none of {' and '.join(map(repr, blind))}"
        raise ValueError(f"{problem}. Add them, or leave the camera out with --without {blind[0]}.")
    known = (*REQUIRED, *detections_file.OPTIONAL, *UNUSED)
    notes = [f"{path.name}: column {shown(name)} ignored" for name in header if name not in known]
    number = np.unique(names, return_inverse=True)[1]
    kept = detections_file.without_repeats((number,), values)
    if len(kept) < len(names):
        notes.append(f"{path.name}: {len(names) - len(kept)} exact repeats of rows dropped")
    names, values = names[kept], {name: column[kept] for name, column in values.items()}
    found = []
    for camera in cameras:
        mine = {column: numbers[names == camera.name] for column, numbers in values.items()}
        frames, first, frame = np.unique(mine["t"], return_index=True, return_inverse=True)
        detections_file.check_inside(path, camera.name, camera.size, np.column_stack((mine["u"], mine["v"])))
        order = np.argsort(frame, kind="stable")
        pixels, way = np.column_stack((mine["u"], mine["v"])), detections_file.streaks_of(mine)
        way[(way == 0.0).all(axis=1)] = np.nan
        streaks = (pixels[:, None] + 0.5 * way[:, None] * np.array([[-1.0], [1.0]]))[order]
        spread, scores = detections_file.covariances(mine)[order], mine[detections_file.SCORE][order]
        radii = detections_file.radii_of(mine)[order]
        shifts = detections_file.shifts_of(mine)
        shifts = None if shifts is None else shifts[first]
        own = (frame[order], pixels[order], spread, scores, streaks, shifts, radii)
        found.append(Detections(camera.name, frames, *own))
        check_step(f"{path}, camera {shown(camera.name)}", frames)
    return found, notes
