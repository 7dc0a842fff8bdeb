"""Reads and writes `detections.csv`: its columns, their rules and noise, and the sightings of each ball."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array, Index
from ballfg.checks import LARGEST, NAME_RULE, did_you_mean, is_name, shown
from ballfg.files.damaged import check_unpacked
from ballfg.files.spreadsheet import bare
from ballfg.progress import counted
from ballfg.tracks import csv_files
from ballfg.tracks.checks import check_step
from ballfg.tracks.rows import KEY, distinct
from ballfg.tracks.sightings import Sightings

Texts = NDArray[np.str_]
Rule = tuple[str, Callable[[Array], NDArray[np.bool_]]]  # the rule for the numbers of a column, in words and as a test
CAMERA: Final = "camera"
PLACE: Final = ("t", "u", "v")
NOISE: Final = ("sigma_u", "sigma_v", "rho_uv")
SCORE: Final = "score"
RADIUS: Final = ("radius", "sigma_radius")
STREAK: Final = ("streak_u", "streak_v")
SHIFT: Final = ("shift_x", "shift_y", "shift_z")
OPTIONAL: Final = (*NOISE, *RADIUS, *STREAK, *SHIFT, SCORE)
UNSTATED: Final = {"sigma_u": 0.5, "sigma_v": 0.5, "rho_uv": 0.0}  # px; half a pixel, as of patch centres
LEAST_SIGMA: Final = 1e-4  # px, best resolution of a camera; far surer pixels cannot be solved in double precision
MOST_PIXELS: Final = 1e6  # px. Largest width of an image; larger numbers overflow when squared.
_SIGMA: Final[Rule] = (f"{LEAST_SIGMA:g} to {MOST_PIXELS:.0f} px", lambda x: (x >= LEAST_SIGMA) & (x <= MOST_PIXELS))
_PIXEL: Final[Rule] = (f"finite, at most {MOST_PIXELS:.0f} px", lambda x: np.abs(x) <= MOST_PIXELS)
RULES: Final[Mapping[str, Rule]] = {
    "u": _PIXEL,
    "v": _PIXEL,
    "sigma_u": _SIGMA,
    "sigma_v": _SIGMA,
    "rho_uv": ("between -1 and 1", lambda x: np.abs(x) < 1.0),
    "radius": (f"0 (unknown) to {MOST_PIXELS:.0f} px", lambda x: (x >= 0.0) & (x <= MOST_PIXELS)),
    "sigma_radius": _SIGMA,
    "streak_u": _PIXEL,
    "streak_v": _PIXEL,
}
DETECTIONS_FILE: Final = "detections.csv"
EVENTS_FILE: Final = "events.csv"  # hits, bounces and ends of the same balls, where one camera saw them
REQUIRED: Final = (KEY, "t", CAMERA, "u", "v")
BEYOND: Final = 0.05
"""Share of a picture's size by which a place may lie beyond it: the centre of a ball that is cut by the border."""


def read_sightings(
    path: str | os.PathLike[str], time_offsets: Mapping[str, float]
) -> tuple[dict[str, Sightings], list[str]]:
    """The sightings of each ball in the file.

    Rows without a trajectory are unassigned candidates; they are left out. Of several rows of one ball, camera and
    stamp the one with the highest score counts. Exact repeats are dropped. The order of rows is free.

    Args:
        path: a table `trajectory,t,camera,u,v` (t in s, as recorded by the camera, u and v in px), optionally with
            `sigma_u`, `sigma_v` (px), `rho_uv`, `radius` of the ball in the picture (px; 0: unknown), `sigma_radius`
            (px), `streak_u` and `streak_v` from one end of its streak to the other (px; 0: unknown), `shift_x`,
            `shift_y`, `shift_z` to where the camera stood from its place (m; 0: there), and `score`.
        time_offsets: s, by camera of the rig: rows are sorted by t less the offset.
    Returns: sightings by trajectory, in the order in which the trajectories first appear; ignored entries, one sentence
        each.
    Raises: FileNotFoundError: there is no such file. ValueError: a missing or repeated column, a cell out of its range,
        an unknown camera, or several candidates of one ball with equal scores; the message names file, line and column.
    """
    path = Path(path)
    header, texts, numbers = read_columns(path, REQUIRED)
    (lines,) = np.nonzero(np.char.strip(texts[KEY]) != "")
    values = {name: column[lines] for name, column in numbers.items()}
    check_values(path, values, lines)
    check_cameras(path, texts[CAMERA][lines], lines, list(time_offsets))
    values |= {name: np.full(len(lines), value) for name, value in UNSTATED.items() if name not in values}
    number_of = {name: number for number, name in enumerate(time_offsets)}
    seen_by = np.array([number_of[name] for name in texts[CAMERA][lines].tolist()], dtype=np.int64)
    names = texts[KEY][lines]
    notes = [f"{path.name}: column {shown(name)} ignored" for name in header if name not in (*REQUIRED, *OPTIONAL)]
    if nameless := len(texts[KEY]) - len(lines):
        notes.append(f"{path.name}: {counted(nameless, 'row')} without a trajectory left out")
    once = without_repeats((np.unique(names, return_inverse=True)[1], seen_by), values)
    if repeats := len(names) - len(once):
        notes.append(f"{path.name}: {repeats} exact repeats of rows dropped")
        lines, names, seen_by = lines[once], names[once], seen_by[once]
        values = {column: cells[once] for column, cells in values.items()}
    rows, doubles = _chosen(path, lines, names, seen_by, values)
    if doubles:
        notes.append(f"{path.name}: {doubles} candidates with a lower score than another of the same ball left out")
    for number, camera in enumerate(time_offsets):
        check_step(f"{path}, camera {shown(camera)}", np.unique(values["t"][rows][seen_by[rows] == number]))
    offsets = np.array(list(time_offsets.values()))
    rows = rows[np.argsort((values["t"] - offsets[seen_by])[rows], kind="stable")]
    found = {}
    for name in dict.fromkeys(names.tolist()):
        mine = rows[names[rows] == name]
        own = {column: cells[mine] for column, cells in values.items()}
        pixels = np.column_stack((own["u"], own["v"]))
        radii = radii_of(own) if RADIUS[0] in own else None
        streaks = streaks_of(own) if any(one in own for one in STREAK) else None
        cues = (covariances(own), radii, streaks, shifts_of(own))
        found[name] = Sightings(tuple(time_offsets), seen_by[mine], own["t"], pixels, *cues)
    return found, notes


def without_repeats(numbers: Sequence[Index], values: Mapping[str, Array]) -> Index:
    """Indices of rows, each of them once; rows are equal by all numbers (n,), of texts, and columns (n,)."""
    return np.sort(np.unique(np.column_stack((*numbers, *values.values())), axis=0, return_index=True)[1])


def _chosen(path: Path, lines: Index, names: Texts, camera: Index, values: Mapping[str, Array]) -> tuple[Index, int]:
    """The best scored row for each ball, camera and stamp; the number of others. Raises: ValueError: equal scores."""
    score = values.get(SCORE, np.zeros(len(lines)))
    order = np.lexsort((-score, values["t"], camera, names))
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for column in (names, camera, values["t"]):
        same &= column[order[1:]] == column[order[:-1]]
    tied = same & (score[order[1:]] == score[order[:-1]])
    if tied.any():
        pair = np.sort(lines[order[int(np.argmax(tied)) :][:2]])
        one, other = csv_files.lines_of_rows(path, pair.tolist())
        raise ValueError(
            f"{path}, lines {one} and {other}: one ball must be seen once in a frame, or the scores must tell "
            "which candidate it is; they do not. Delete one of them."
        )
    return np.sort(order[np.append(True, ~same)]) if len(order) else order, int(same.sum())


def read_columns(path: Path, required: Sequence[str]) -> tuple[list[str], dict[str, Texts], dict[str, Array]]:
    """The columns of a table, cells not yet checked.

    Returns: the header; (n,) texts and (n,) numbers by column, of the required and the present optional ones.
    Raises: FileNotFoundError: no such file. ValueError: a missing or repeated column, a line or a cell that cannot be
        read; the message names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: must be a table of detections; there is none. Correct the path.")
    header = csv_files.read_header(path)
    csv_files.check_header(path, header, required, (*required, *OPTIONAL))
    texts = [name for name in (KEY, CAMERA) if name in required]
    numbers: list[str] = [name for name in (*PLACE, *OPTIONAL) if name in header]
    try:
        options = pa_csv.ReadOptions(use_threads=False)
        table = pa_csv.read_csv(path, options, convert_options=csv_files.convert_options(texts, numbers))
    except pa.ArrowInvalid as error:
        raise csv_files.explain(path, numbers, str(error)) from None
    values = {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in numbers}
    if set(RADIUS) <= values.keys():  # both are 0 where a program has no radius to write
        radius, sigma = (values[name] for name in RADIUS)
        values[RADIUS[1]] = np.where((radius == 0.0) & (sigma == 0.0), UNSTATED["sigma_u"], sigma)
    return header, {name: _texts(path, name, table.column(name)) for name in texts}, values


def read_candidates(path: Path, required: Sequence[str]) -> tuple[list[str], dict[str, Texts], dict[str, Array]]:
    """`read_columns` of candidates: cells checked, scores 0 to 1, and what is not stated filled in; errors as there."""
    header, texts, values = read_columns(path, required)
    count = len(values["t"])
    check_values(path, values, np.arange(count), {**RULES, SCORE: ("0 to 1", lambda x: (x >= 0.0) & (x <= 1.0))})
    unstated = UNSTATED | {SCORE: 1.0}  # somebody has chosen them
    return header, texts, {name: np.full(count, value) for name, value in unstated.items()} | values


def _texts(path: Path, name: str, column: pa.ChunkedArray) -> Texts:
    """(n,) names of balls, which may be missing, or of cameras."""
    words, codes = distinct(column.unify_dictionaries().combine_chunks())
    plain = [bare(word or "") for word in words]
    for code, word in enumerate(plain):
        if word.strip() and not is_name(word):
            place = _place(path, np.flatnonzero(codes == code), name)
            raise ValueError(f"{place} must be {NAME_RULE}; got {shown(word)}. Rename it.")
    check_unpacked(path, 4 * len(codes) * max(map(len, plain), default=0))
    return np.array(plain, dtype=np.str_)[codes]


def check_values(
    path: Path, values: Mapping[str, Array], lines: NDArray[np.int64], rules: Mapping[str, Rule] = RULES
) -> None:
    """Refuses cells of columns (n,), of rows with these numbers in the file, out of their range. Raises: ValueError."""
    for name, column in values.items():
        rule, holds = rules.get(name, (f"finite, at most {LARGEST:g} in size", np.isfinite))
        wrong = ~((np.abs(column) <= LARGEST) & holds(column))
        if wrong.any():
            problem = f"{_place(path, lines[wrong], name)} must be {rule}; got {column[wrong][0]:g}"
            raise ValueError(f"{problem}. Correct it or delete the line.")


def check_cameras(
    path: Path, names: Texts, lines: NDArray[np.int64], cameras: Sequence[str], ignored: Sequence[str] = ()
) -> None:
    """Refuses rows of a camera, names (n,), neither in `cameras` nor `ignored`. Raises: ValueError: with the line."""
    strange = ~np.isin(names, [*cameras, *ignored])
    if strange.any():
        got = str(names[int(np.argmax(strange))])
        raise ValueError(
            f"{_place(path, lines[strange], CAMERA)} must be a camera: {', '.join(cameras)}; got {shown(got)}. "
            f"Rename it, add it to the cameras' file, or delete its rows.{did_you_mean(got, cameras)}"
        )


def check_inside(path: Path, camera: str, size: tuple[int, int], pixels: Array) -> None:
    """Refuses places (n, 2) px beyond a camera's picture of `size` px by more than `BEYOND`. Raises: ValueError."""
    reach = np.array(size, dtype=np.float64)

    def outside(limits: Array) -> NDArray[np.bool_]:
        return np.asarray(((pixels < -BEYOND * limits) | (pixels > (1.0 + BEYOND) * limits)).any(axis=1))

    wrong = outside(reach)
    if not wrong.any():
        return
    u, v = pixels[int(np.argmax(wrong))].tolist()
    right, down = pixels.max(axis=0).tolist()
    cause = f"They reach ({right:.0f}, {down:.0f}): calibrate in the size of the videos, or delete wrong rows."
    if not outside(reach[::-1]).any():
        cause = (
            f"They fit a picture of {size[1]}x{size[0]}: it is probably turned by 90 degrees against that of the "
            "calibration. Turn one of them."
        )
    raise ValueError(
        f"{path}: camera {shown(camera)} has a picture of {size[0]}x{size[1]} px, in which detections must lie; "
        f"{int(wrong.sum())} of {len(wrong)} do not, such as ({u:g}, {v:g}). {cause}"
    )


def covariances(values: Mapping[str, Array]) -> Array:
    """(n, 2, 2) px^2 from the columns of the noise."""
    sigma_u, sigma_v, rho = (values[name] for name in NOISE)
    across = rho * sigma_u * sigma_v
    return np.stack((sigma_u**2, across, across, sigma_v**2), axis=-1).reshape(-1, 2, 2)


def radii_of(values: Mapping[str, Array]) -> Array:
    """(n, 2) px, the ball's radius in the picture and its sigma; 0 and any sigma where a table has none."""
    return _stated(values, dict(zip(RADIUS, (0.0, UNSTATED["sigma_u"]), strict=True)))


def streaks_of(values: Mapping[str, Array]) -> Array:
    """(n, 2) px, from one end of the ball's streak to the other; 0 where a table has none."""
    return _stated(values, dict.fromkeys(STREAK, 0.0))


def shifts_of(values: Mapping[str, Array]) -> Array | None:
    """(n, 3) m, where cameras stood from their places; None where a table does not say that they moved."""
    return _stated(values, dict.fromkeys(SHIFT, 0.0)) if any(name in values for name in SHIFT) else None


def _stated(values: Mapping[str, Array], unstated: Mapping[str, float]) -> Array:
    """(n, k) columns of a table, each with the number that stands for it where the table has none."""
    (count,) = {len(column) for column in values.values()}
    return np.stack([values.get(name, np.full(count, value)) for name, value in unstated.items()], axis=1)


def seen_columns(
    times: Array,
    camera: ArrayLike,
    pixels: Array,
    spread: Array,
    ends: Array | None = None,
    shift: Array | None = None,
    radii: Array | None = None,
) -> dict[str, ArrayLike]:
    """The columns of a table from stamps (n,) s, cameras, pixels (n, 2) and covariances (n, 2, 2) px^2.

    Args:
        ends: (n, 2, 2) px, of streaks, NaN where there are none; None: without their columns.
        shift: (n, 3) m, where the cameras stood from their places; None: without its columns.
        radii: (n, 2) px, of the balls in the picture, 0 where unknown, and standard deviations; None: without.
    """
    sized = {} if radii is None else dict(zip(RADIUS, radii.T, strict=True))
    moved = {} if shift is None else dict(zip(SHIFT, shift.T, strict=True))
    way = {} if ends is None else dict(zip(STREAK, np.nan_to_num(ends[:, 1] - ends[:, 0]).T, strict=True))
    sigma_u, sigma_v = (np.sqrt(spread[:, i, i]) for i in (0, 1))
    noise = {"sigma_u": sigma_u, "sigma_v": sigma_v, "rho_uv": spread[:, 0, 1] / (sigma_u * sigma_v)}
    return {"t": times, CAMERA: camera, "u": pixels[:, 0], "v": pixels[:, 1], **noise, **sized, **way, **moved}


def _place(path: Path, lines: NDArray[np.int64], column: str) -> str:
    (line,) = csv_files.lines_of_rows(path, [int(lines[0])])
    return f"{path}, line {line}, column {shown(column)}:"
