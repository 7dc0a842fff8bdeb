"""The way from the front door to the linear solve stays short enough to be read."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType

import numpy as np

from ballfg import front
from ballfg.tracks import Track


def test_five_functions_in_four_files_lead_to_the_linear_solve() -> None:
    times = np.arange(20) / 100
    track = Track(times, np.column_stack((4.0 * times, 0.1 * times, 0.4 + times - 4.905 * times**2)))
    routes: list[list[tuple[str, str]]] = []

    def watch(frame: FrameType, event: str, called: object) -> None:
        if event == "call" and (frame.f_code.co_name, Path(frame.f_code.co_filename).name) == ("solve", "step.py"):
            route, at = [], frame
            while at is not None and at.f_code.co_name != "test_five_functions_in_four_files_lead_to_the_linear_solve":
                route.append((Path(at.f_code.co_filename).name, at.f_code.co_name))
                at = at.f_back
            routes.append(route[::-1])

    sys.setprofile(watch)
    try:
        front.estimate(track)
    finally:
        sys.setprofile(None)
    ways = {tuple(name for _, name in route) for route in routes}
    assert ways == {("estimate", "estimate", "run", "answer", "solve")}
    assert len({file for route in routes for file, _ in route}) == 4
