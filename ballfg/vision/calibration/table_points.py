"""Defines points of a table-tennis table with known places, and reads their pixels from a file."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_keys, did_you_mean, is_number, shown
from ballfg.files.strict_yaml import mapping, read_mapping
from ballfg.tracks.info import MAX_HEIGHT

TABLE_LENGTH: Final = 2.74
TABLE_WIDTH: Final = 1.525
TABLE_HEIGHT: Final = 0.76  # m, ITTF Laws of Table Tennis 2.1.1 and 2.1.2
CLICK_SIGMA: Final = 0.5  # px, standard deviation of a coordinate that was read off an image with care
_FIELDS: Final = ("table_height", "sigma", "points", "cameras")


@dataclass(frozen=True, eq=False)
class Marked:
    """World points with their pixels in one camera."""

    names: tuple[str, ...]

    points: Array  # (n, 3) m
    pixels: Array  # (n, 2) px
    sigma: float = CLICK_SIGMA  # px, standard deviation of each coordinate of the pixels


def table_points(height: float = TABLE_HEIGHT) -> dict[str, Array]:
    """Points on the table's surface by name, (3,) m each.

    x runs along the table from its near end (x = 0, where the launcher stands) to its far end, y across it (0 in the
    middle, positive to the left of who looks from the near end to the far one), z upwards.

    Args: height: m, z of the surface.
    """
    ends = {"near": 0.0, "net": TABLE_LENGTH / 2, "far": TABLE_LENGTH}
    sides = {"left": TABLE_WIDTH / 2, "middle": 0.0, "right": -TABLE_WIDTH / 2}
    return {f"{end}_{side}": np.array([x, y, height]) for end, x in ends.items() for side, y in sides.items()}


def table_outline(height: float = TABLE_HEIGHT) -> list[Array]:
    """Lines (2, 3) m to draw: the four edges, the middle line, and where the net stands."""
    at = table_points(height)
    corners = [at[name] for name in ("near_left", "far_left", "far_right", "near_right", "near_left")]
    edges = [np.stack(pair) for pair in pairwise(corners)]
    return [*edges, np.stack((at["near_middle"], at["far_middle"])), np.stack((at["net_left"], at["net_right"]))]


def table_ends(text: str) -> tuple[float, float, float, float]:
    """(x_low, x_high, y_low, y_high) m of a text such as `x=-1.37..1.37,y=-0.76..0.76`. Raises: ValueError."""
    number = r"[-+]?[0-9.]+(?:e[-+]?[0-9]+)?"
    found = re.fullmatch(rf"\s*x=({number})\.\.({number})\s*,\s*y=({number})\.\.({number})\s*", text)
    try:
        x_low, x_high, y_low, y_high = map(float, found.groups() if found else ())
    except ValueError:
        problem = f"table must read x=LOW..HIGH,y=LOW..HIGH, m; got {shown(text)}"
        raise ValueError(f"{problem}. Write for instance x=-1.37..1.37,y=-0.76..0.76.") from None
    return x_low, x_high, y_low, y_high


@dataclass(frozen=True, eq=False)
class TableFile:
    """The content of a table file."""

    table_height: float  # m, z of the table's surface
    cameras: Mapping[str, Marked]  # the marked points of each camera, by name


def read_table(path: str | PathLike[str]) -> TableFile:
    """The pixels of table points (docs/calibrate.md). Raises: FileNotFoundError. ValueError: a bad field, named."""
    path = Path(path)
    content = read_mapping(path)
    check_keys(str(path), content, _FIELDS, ("cameras",))
    height = _number(f"{path}: table_height", content.get("table_height", TABLE_HEIGHT))
    if not abs(height) <= MAX_HEIGHT:
        raise ValueError(f"{path}: table_height must be in m, at most {MAX_HEIGHT:g}; got {height:g}. Is it mm?")
    sigma = _number(f"{path}: sigma", content.get("sigma", CLICK_SIGMA))
    if not sigma > 0.0:
        raise ValueError(f"{path}: sigma must be above 0 px; got {sigma:g}. Say how well pixels were read off.")
    known = table_points(height)
    own = mapping(f"{path}: points", content["points"]) if "points" in content else {}
    for name, place in own.items():
        known[name] = _numbers(f"{path}: point {shown(name)}", place, 3, "its x, y, z in m")
    cameras = {
        name: _marked(f"{path}: camera {shown(name)}", seen, known, sigma)
        for name, seen in mapping(f"{path}: cameras", content["cameras"]).items()
    }
    return TableFile(height, cameras)


def _marked(where: str, content: Any, known: Mapping[str, Array], sigma: float) -> Marked:
    seen = mapping(where, content)
    for name in seen:
        if name not in known:
            hint = did_you_mean(str(name), known)
            raise ValueError(
                f"{where}: points must be among {', '.join(known)}; got {shown(name)}.{hint} Put others in points."
            )
    pixels = [_numbers(f"{where}: {name}", pixel, 2, "where it is seen, in px") for name, pixel in seen.items()]
    return Marked(tuple(seen), np.stack([known[name] for name in seen]), np.stack(pixels), sigma)


def _numbers(where: str, value: Any, count: int, what: str) -> Array:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{where} must be {count} numbers, {what}; got {shown(value)}. Correct it.")
    return np.array([_number(where, number) for number in value])


def _number(where: str, value: Any) -> float:
    if not is_number(value) or not np.isfinite(value):
        raise ValueError(f"{where} must be a finite number; got {shown(value)}. Correct it.")
    return float(value)
