"""Planes as they are written in commands, and what is refused."""

import numpy as np
import pytest

from ballfg.prediction import Plane


@pytest.mark.parametrize(
    ("text", "plane"),
    [
        ("x=2.0", Plane((1.0, 0.0, 0.0), 2.0)),
        (" y = -0.5 ", Plane((0.0, 1.0, 0.0), -0.5)),
        ("z=3.05,down", Plane((0.0, 0.0, 1.0), 3.05, "down")),
        ("z=0.9, up, after=2", Plane((0.0, 0.0, 1.0), 0.9, "up", 2)),
        ("z=0.9,after=1", Plane((0.0, 0.0, 1.0), 0.9, "either", 1)),
        ("0.6:0:0.8=1.2", Plane((0.6, 0.0, 0.8), 1.2)),
    ],
)
def test_planes_are_read(text, plane):
    assert Plane.parse(text) == plane


@pytest.mark.parametrize(
    "text", ["x", "w=1", "x=one", "x=nan", "x=1=2", "z=1,sideways", "z=1,up,down", "z=1,after=", "1:0=2", "0:0:inf=1"]
)
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match=r"plane must be an axis and a place in m; got .* Write x=2\.0"):
        Plane.parse(text)


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        (((0.0, 0.0, 0.0), 1.0), "normal must be"),
        (((1.0, 0.0, 0.0), np.inf), "offset must be"),
        (((1.0, 0.0, 0.0), 1.0, "left"), "direction must be .*got 'left'"),
        (((1.0, 0.0, 0.0), 1.0, "up", 21), r"after must lie in 0 \.\. 20; got 21"),
    ],
)
def test_planes_that_are_none_are_refused(given, rule):
    with pytest.raises(ValueError, match=rule):
        Plane(*given)
