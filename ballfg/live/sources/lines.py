"""Reads the lines of a stream as samples: CSV `t,x,y,z` or JSON, each line by itself."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ballfg.files.json_file import parse_json

LONGEST = 65536  # Largest number of bytes of a line; the rest of a longer one is skipped
MOST_POSITIONS = 64
"""Largest number of positions of one stamp: more than the tracker follows. Thousands would delay everybody."""
COLUMNS = ("t", "x", "y", "z")
SIGMAS = ("sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True)
class Sample:
    """The content of one line: the positions of one stamp.

    Attributes:
        time: s.  positions: of each ball x, y, z in m.  sigmas: as many standard deviations, m; None without them.
        tag: further fields of the answer, such as the trajectory of a replay.
    """

    time: float
    positions: list[list[float]]
    sigmas: list[list[float]] | None = None
    tag: tuple[tuple[str, Any], ...] = ()


class LineReader:
    """Reads the lines of one sender; a header names the columns of the CSV lines that follow."""

    def __init__(self) -> None:
        self._order: list[int] | None = None
        self._sigma_order: list[int] | None = None
        self._width = 0

    def read(self, line: bytes) -> Sample | None:
        """The sample of a line; None for a header, a comment or an empty line. Raises: ValueError: any other line."""
        if len(line) > LONGEST:
            raise ValueError(f"a line must have at most {LONGEST} bytes; got more. Send one sample a line.")
        text = line.decode("utf-8", errors="replace").strip().removeprefix("\ufeff")
        if not text or text.startswith("#"):
            return None
        if text[0] in "{[":
            return _of_json(text)
        cells = [cell.strip() for cell in text.split(",")]
        if all(name in cells for name in COLUMNS):
            self._order = [cells.index(name) for name in COLUMNS]
            self._sigma_order = [cells.index(name) for name in SIGMAS] if all(s in cells for s in SIGMAS) else None
            self._width = len(cells)
            return None
        return self._of_cells(cells)

    def _of_cells(self, cells: list[str]) -> Sample:
        if self._order is None:
            if len(cells) not in (4, 7):
                raise ValueError(
                    f"a CSV line must be t,x,y,z or t,x,y,z,sigma_x,sigma_y,sigma_z; got {len(cells)} cells"
                )
            numbers = _numbers(cells)
            return Sample(numbers[0], [numbers[1:4]], [numbers[4:]] if len(numbers) == 7 else None)
        if len(cells) != self._width:
            raise ValueError(f"a line must have the {self._width} cells of its header; got {len(cells)}")
        t, *position = _numbers([cells[i] for i in self._order])
        own = None if self._sigma_order is None else [_numbers([cells[i] for i in self._sigma_order])]
        return Sample(t, [position], own)


def _numbers(cells: Sequence[Any]) -> list[float]:
    found = []
    for cell in cells:
        try:
            if isinstance(cell, bool):
                raise TypeError
            found.append(float(cell))
        except (TypeError, ValueError):
            raise ValueError(f"a number was expected; got {str(cell)[:40]!r}") from None
    return found


def _of_json(text: str) -> Sample:
    """An object with t and x, y, z, or position, or positions; or the array [t, x, y, z]."""
    try:
        content = parse_json(text)
    except ValueError as error:
        raise ValueError(f"not valid JSON: {error}") from None
    if isinstance(content, list):
        content = dict(zip(COLUMNS, content, strict=False)) if len(content) == 4 else {}
    if not isinstance(content, dict) or "t" not in content:
        raise ValueError("a JSON line must be an object with t and x, y, z, or the array [t, x, y, z]")
    if "positions" in content:
        given = content["positions"]
    elif "position" in content:
        given = [content["position"]]
    else:
        given = [[content.get(axis) for axis in COLUMNS[1:]]]
    positions = _triples("positions", given)
    if not positions:
        raise ValueError("positions must hold at least one; got none")
    if len(positions) > MOST_POSITIONS:
        raise ValueError(f"positions must be at most {MOST_POSITIONS}; got {len(positions)}")
    (time,) = _numbers([content["t"]])
    return Sample(time, positions, _spreads(content.get("sigma"), len(positions)))


def _spreads(given: Any, count: int) -> list[list[float]] | None:
    """Standard deviations: one number for all, three for all, or three for each position."""
    if given is None:
        return None
    if not isinstance(given, list):
        return [_numbers([given] * 3)] * count
    if not any(isinstance(row, list) for row in given):
        return _triples("sigma", [given]) * count
    spreads = _triples("sigma", given)
    if len(spreads) != count:
        raise ValueError(f"sigma must be one for each of {count} positions; got {len(spreads)}")
    return spreads


def _triples(name: str, given: Any) -> list[list[float]]:
    if not isinstance(given, list) or not all(isinstance(row, list) and len(row) == 3 for row in given):
        raise ValueError(f"{name} must be lists of three numbers; got {json.dumps(given)[:60]}")
    return [_numbers(row) for row in given]
