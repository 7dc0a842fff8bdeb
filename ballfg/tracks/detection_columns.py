"""What tables of detections have in common, whether a row names its ball or not: columns, rules, noise."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import ArrayLike, NDArray

from ballfg.checks import did_you_mean
from ballfg.tracks import csv_files
from ballfg.tracks.rows import KEY

Array = NDArray[np.float64]
Texts = NDArray[np.str_]
Rule = tuple[str, Callable[[Array], NDArray[np.bool_]]]
"""What the numbers of a column must be, in words and as a test."""

CAMERA: Final = "camera"
PLACE: Final = ("t", "u", "v")
NOISE: Final = ("sigma_u", "sigma_v", "rho_uv")
SCORE: Final = "score"
OPTIONAL: Final = (*NOISE, SCORE)
UNSTATED: Final = {"sigma_u": 0.5, "sigma_v": 0.5, "rho_uv": 0.0}
"""px. Half a pixel: what a detector reaches that looks for the middle of a patch."""
LEAST_SIGMA: Final = 1e-4
"""px. No camera tells a ball's centre better; a graph with far surer pixels cannot be solved in double precision."""
_SIGMA: Final[Rule] = (f"{LEAST_SIGMA:g} px or more", lambda x: x >= LEAST_SIGMA)
RULES: Final[Mapping[str, Rule]] = {
    "sigma_u": _SIGMA,
    "sigma_v": _SIGMA,
    "rho_uv": ("between -1 and 1", lambda x: np.abs(x) < 1.0),
}


def read_columns(path: Path, required: Sequence[str]) -> tuple[list[str], dict[str, Texts], dict[str, Array]]:
    """The columns of a table, cells not yet checked.

    Args: path: of the table.  required: columns that it must have.
    Returns: the header; (n,) texts and (n,) numbers by column, of the required and the optional ones that are there.
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
    return (
        header,
        {name: np.array(table.column(name).to_pylist(), dtype=np.str_) for name in texts},
        {name: np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in numbers},
    )


def check_values(
    path: Path, values: Mapping[str, Array], lines: NDArray[np.int64], rules: Mapping[str, Rule] = RULES
) -> None:
    """Refuses cells out of their range.

    Args:
        path: of the table.  values: (n,) of each column.  lines: (n,) numbers of their rows in the file.
        rules: by column; others must be finite.
    Raises: ValueError: naming line and column.
    """
    for name, column in values.items():
        rule, holds = rules.get(name, ("finite", np.isfinite))
        wrong = ~(np.isfinite(column) & holds(column))
        if wrong.any():
            raise ValueError(
                f"{_place(path, lines[wrong], name)} must be {rule}; got {column[wrong][0]:g}. "
                "Correct it or delete the line."
            )


def check_cameras(
    path: Path, names: Texts, lines: NDArray[np.int64], cameras: Sequence[str], ignored: Sequence[str] = ()
) -> None:
    """Refuses a row of a camera that is neither one of `cameras` nor `ignored`.

    Args: path: of the table.  names: (n,) of the cameras.  lines: (n,) numbers of their rows in the file.
    Raises: ValueError: naming the line.
    """
    strange = ~np.isin(names, [*cameras, *ignored])
    if strange.any():
        got = str(names[int(np.argmax(strange))])
        raise ValueError(
            f"{_place(path, lines[strange], CAMERA)} must be a camera: {', '.join(cameras)}; got {got!r}. "
            f"Rename it, add it to the cameras' file, or delete its rows.{did_you_mean(got, cameras)}"
        )


def covariances(values: Mapping[str, Array]) -> Array:
    """(n, 2, 2) px^2 from the columns of the noise."""
    sigma_u, sigma_v, rho = (values[name] for name in NOISE)
    across = rho * sigma_u * sigma_v
    return np.stack((sigma_u**2, across, across, sigma_v**2), axis=-1).reshape(-1, 2, 2)


def seen_columns(times: Array, camera: ArrayLike, pixels: Array, spread: Array) -> dict[str, ArrayLike]:
    """The columns of a table from stamps (n,) s, cameras, pixels (n, 2) and covariances (n, 2, 2) px^2."""
    sigma_u, sigma_v = (np.sqrt(spread[:, i, i]) for i in (0, 1))
    return {
        "t": times,
        CAMERA: camera,
        "u": pixels[:, 0],
        "v": pixels[:, 1],
        "sigma_u": sigma_u,
        "sigma_v": sigma_v,
        "rho_uv": spread[:, 0, 1] / (sigma_u * sigma_v),
    }


def _place(path: Path, lines: NDArray[np.int64], column: str) -> str:
    """The first of some rows of the file, and the column, for a message."""
    (line,) = csv_files.lines_of_rows(path, [int(lines[0])])
    return f"{path}, line {line}, column {column!r}:"
