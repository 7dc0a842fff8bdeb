"""The way from the front door to the elimination stays short enough to be read."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from types import FrameType

import numpy as np

from ballfg import front
from ballfg.estimation import Smoother
from ballfg.factors import LevenbergMarquardt
from ballfg.factors.linear import elimination, step
from ballfg.tracks import Track


def test_six_functions_in_five_files_lead_to_the_elimination(monkeypatch) -> None:
    """No generator is on the way: one would wait outside of the stack, and would not be counted."""
    times = np.arange(20) / 100
    track = Track(times, np.column_stack((4.0 * times, 0.1 * times, 0.4 + times - 4.905 * times**2)))
    routes: list[list[tuple[str, str]]] = []
    eliminate = elimination.eliminate

    def watched(*arguments: object) -> None:
        routes.append(_route(sys._getframe(1)))
        eliminate(*arguments)

    monkeypatch.setattr(step.elimination, "eliminate", watched)
    front.estimate(track)
    ways = {tuple(name for _, name in route) for route in routes}
    assert ("estimate", "estimate", "settle", "minimize", "solve") in ways  # and eliminate, which is machine code
    shortest = min(routes, key=len)
    assert len({file for file, _ in shortest} | {"elimination.py"}) == 5
    assert not inspect.isgeneratorfunction(LevenbergMarquardt.minimize)
    assert not any(inspect.isgeneratorfunction(way) for way in (Smoother.estimate, Smoother.settle))


def _route(frame: FrameType | None) -> list[tuple[str, str]]:
    """Files and functions from the front door to a frame."""
    found: list[tuple[str, str]] = []
    while frame is not None and (not found or found[-1] != ("front.py", "estimate")):
        found.append((Path(frame.f_code.co_filename).name, frame.f_code.co_name))
        frame = frame.f_back
    return found[::-1]
