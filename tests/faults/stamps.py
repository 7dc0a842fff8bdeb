"""Every command and call on the same shots with stamps from 0 and from 1.7e9 s, both written to the microsecond.

    python -m tests.faults.stamps

prints for each the largest difference of any number, in standard deviations. Numbers that come without one are compared
with their own size; a count, a name or a sentence that differs counts as infinite.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.faults.stamped_calls import CALLS
from tests.faults.stamped_commands import COMMANDS, Numbers
from tests.faults.stamped_shots import write_shots

SHIFT = 1_700_000_000_123_457
"""us, the stamp of the first sample of all in the later data."""
TIMES = re.compile(r"(^|\.)(t|t_input|t_track|time)$")
"""Names of numbers on the data's clock."""
TIME_SIGMA = 1e-3
"""s. Stamps and contacts differ by a quarter of a microsecond, as doubles of that size do."""
LEAST = 1e-6
"""Numbers of less than that are zero, in any unit."""
WHITENED = "innovation"
"""Part of the names of numbers that are in standard deviations already."""
CASES: dict[str, Callable[[Path, int], Numbers]] = {**COMMANDS, **CALLS}


def difference(early: Numbers, late: Numbers, shift: float) -> tuple[float, str]:
    """The largest difference of two results, and of what; shift: s, of the later one's clock."""
    if early.keys() != late.keys():
        return np.inf, f"one has {sorted(early.keys() ^ late.keys())[:3]}"
    worst, where = 0.0, "nothing"
    for name, value in early.items():
        if not name.endswith("sigma"):
            apart = _apart(name, value, late[name], early.get(f"{name}.sigma"), shift)
            worst, where = max((worst, where), (apart, name))
    return worst, where


def _apart(name: str, early: Any, late: Any, sigma: Any, shift: float) -> float:
    if isinstance(early, str | list | tuple | bool) or early is None or late is None:
        return 0.0 if early == late else np.inf
    one, other = np.asarray(early, dtype=np.float64), np.asarray(late, dtype=np.float64)
    if one.shape != other.shape or (np.isnan(one) != np.isnan(other)).any():
        return np.inf
    stamps = bool(TIMES.search(name))
    # an imported dataset counts from its own first stamp
    moved = shift if stamps and one.size and abs(float(other.flat[0]) - float(one.flat[0])) > 1.0 else 0.0
    size = np.maximum(np.abs(one), np.abs(other))
    scale = np.maximum(size, LEAST) if sigma is None else np.asarray(sigma)
    scale = np.array(TIME_SIGMA if stamps else 1.0) if stamps or WHITENED in name else scale
    return float(np.nanmax(np.abs(one - (other - moved)) / scale, initial=0.0))


def measured(name: str, tracks: int, seed: int) -> tuple[float, str]:
    """The largest difference that a case shows, and of what."""
    results = []
    with tempfile.TemporaryDirectory(prefix="ballfg-stamps-") as place:
        for shift in (0, SHIFT):
            folder = Path(place) / str(shift)
            write_shots(folder, shift, tracks, seed)
            if name == "bf.predict(folder, observe=0.25, conformal)":
                write_shots(folder / "more", shift, 20, seed + 1)
            before = Path.cwd()
            os.chdir(folder)
            try:
                results.append(CASES[name](Path("."), shift))
            finally:
                os.chdir(before)
    return difference(*results, SHIFT * 1e-6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, default=12)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--only", default="", help="part of the names of cases")
    given = parser.parse_args()
    for name in CASES:
        if given.only in name:
            worst, where = measured(name, given.tracks, given.seed)
            print(f"{name:50} {worst:9.2g}  ({where})", flush=True)


if __name__ == "__main__":
    main()
