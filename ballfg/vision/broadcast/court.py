"""Defines a court: points and lines with known places, from a name or a file; reads its corners in pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_keys, is_number, shown
from ballfg.files.strict_yaml import mapping, read_mapping
from ballfg.tracks import csv_files
from ballfg.vision.calibration.table_points import TABLE_HEIGHT, TABLE_LENGTH, TABLE_WIDTH

TABLE_TENNIS: Final = "table-tennis"
LINE_WIDTH: Final = 0.02  # m (ITTF Laws 2.1.4); the middle line of doubles has 3 mm
NET_HEIGHT, NET_REACH = 0.1525, 0.1525
"""m, of the net above the table, and of its posts beyond the side lines (ITTF Laws 2.2)."""
LARGEST: Final = 200.0  # m, of a coordinate
CORNERS: Final = 4


@dataclass(frozen=True, eq=False)
class Court:
    """The painted lines of a court, in a world with the court's middle as origin, x along it and z upwards.

    Attributes:
        corners: (4, 3) m, around the court; of its longest rectangle, to the outer edges of its lines.
        lines: (l, 2, 3) m, ends of the middles of its lines.  across: (l, 3) m, from one edge of each to the other.
        net: m, height of the net at x = 0; 0 for none.  net_reach: m, half its width.
        floor: m, z of a floor below a table; None: there is none.
    """

    corners: Array
    lines: Array
    across: Array
    net: float
    net_reach: float
    floor: float | None

    @property
    def size(self) -> Array:
        """(2,) m, half length along x and half width along y."""
        return np.asarray(np.abs(self.corners[:, :2]).max(axis=0))


def table_tennis() -> Court:
    """The table of the laws: edges, middle line, and the upper edge of the net, with the surface at z = 0."""
    x, y = TABLE_LENGTH / 2.0, TABLE_WIDTH / 2.0
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return _court(
        corners,
        [(corners[i], corners[(i + 1) % CORNERS]) for i in range(CORNERS)]
        + [(np.array([-x, 0.0, 0.0]), np.array([x, 0.0, 0.0]))],
        LINE_WIDTH,
        (NET_HEIGHT, y + NET_REACH),
        -TABLE_HEIGHT,
    )


def read_court(source: str) -> Court:
    """The court of a name, `table-tennis`, or of a YAML file.

    The file holds `points` (name: [x, y] in m; the middle of the court is [0, 0], x runs along it), `corners` (four
    names, around it), `lines` (pairs of names), `line_width` (m), optionally `net` ([height, half width] in m, at
    x = 0) and `floor` (m, z of a floor below a table). Points lie on the outer edges of the lines.

    Raises: FileNotFoundError. ValueError: a field that is missing or wrong; the message names it.
    """
    if source == TABLE_TENNIS:
        return table_tennis()
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(f"--court must be {TABLE_TENNIS} or a YAML file; {source} does not exist. Check it.")
    content = read_mapping(path)
    needed = ("points", "corners", "lines", "line_width")
    check_keys(str(path), content, (*needed, "net", "floor"), needed)
    known = {
        name: np.append(_numbers(f"{path}: point {shown(name)}", at, 2), 0.0)
        for name, at in mapping(f"{path}: points", content["points"]).items()
    }
    corners = _named(f"{path}: corners", content["corners"], CORNERS, known)
    if not isinstance(content["lines"], list):
        raise ValueError(f"{path}: lines must be a list of pairs of points; got {shown(content['lines'])}. Correct it.")
    lines = [_named(f"{path}: line {i + 1}", pair, 2, known) for i, pair in enumerate(content["lines"])]
    (width,) = _numbers(f"{path}: line_width", [content["line_width"]], 1)
    net = tuple(_numbers(f"{path}: net", content["net"], 2).tolist()) if "net" in content else None
    floor = float(_numbers(f"{path}: floor", [content["floor"]], 1)[0]) if "floor" in content else None
    return _court(np.stack(corners), [(a, b) for a, b in lines], float(width), net, floor)


def read_corners(path: Path) -> dict[int, Array]:
    """Corners of the court (4, 2) px in some pictures, in any order.

    Args: path: a table `frame,u,v` with four rows for each of its pictures, counted from 0.
    Raises: FileNotFoundError. ValueError: a column that is missing, a cell that is no number, a picture without four
        corners; the message names the file and the picture.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--corners {path} does not exist. Check the path.")
    names = [name.strip() for name in csv_files.read_header(path)]
    if not {"frame", "u", "v"} <= set(names):
        raise ValueError(f"{path} must have the columns frame, u, v; got {', '.join(names)}. Name them in line 1.")
    found = dict[int, list[tuple[float, float]]]()
    for line, cells in csv_files.records(path):
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if not all(csv_files.is_number(row.get(name, "")) for name in ("frame", "u", "v")):
            raise ValueError(f"{path}, line {line}: frame, u and v must be numbers. Correct it.")
        if float(row["frame"]) % 1.0 != 0.0:
            raise ValueError(
                f"{path}, line {line}: frame must be a picture's number, from 0 on; got {row['frame']}. Correct it."
            )
        found.setdefault(int(float(row["frame"])), []).append((float(row["u"]), float(row["v"])))
    for frame, points in found.items():
        if len(points) != CORNERS:
            raise ValueError(f"{path}: picture {frame} must have {CORNERS} corners; got {len(points)}. Correct it.")
    return {frame: np.array(points) for frame, points in found.items()}


def _court(
    corners: Array,
    lines: list[tuple[Array, Array]],
    width: float,
    net: tuple[float, float] | None,
    floor: float | None,
) -> Court:
    """The court whose lines' outer edges are given: the middle of a line on the border lies half a width inside."""
    ends = np.array(lines)
    half = np.abs(corners[:, :2]).max(axis=0)
    for axis in (0, 1):
        border = np.isclose(np.abs(ends[:, :, axis]), half[axis]).all(axis=1)
        ends[border, :, axis] -= 0.5 * width * np.sign(ends[border, :, axis])
    along = ends[:, 1] - ends[:, 0]
    across = width * np.cross((0.0, 0.0, 1.0), along / np.linalg.norm(along, axis=1, keepdims=True))
    if net is not None:
        ends = np.concatenate((ends, [[[0.0, -net[1], net[0]], [0.0, net[1], net[0]]]]))
        across = np.concatenate((across, [[0.0, 0.0, width]]))
    return Court(corners, ends, across, *((0.0, 0.0) if net is None else net), floor)


def _named(where: str, names: Any, count: int, known: dict[str, Array]) -> list[Array]:
    if not isinstance(names, list) or len(names) != count or not all(name in known for name in names):
        raise ValueError(f"{where} must be {count} names among {', '.join(known)}; got {shown(names)}. Correct it.")
    return [known[name] for name in names]


def _numbers(where: str, value: Any, count: int) -> Array:
    good = isinstance(value, list) and len(value) == count and all(is_number(number) for number in value)
    if not good or not (np.abs(array := np.array(value, dtype=np.float64)) <= LARGEST).all():
        raise ValueError(f"{where} must be {count} numbers in m, at most {LARGEST:g}; got {shown(value)}. Correct it.")
    return array
