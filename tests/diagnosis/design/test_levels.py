"""Candidate settings from a text."""

from __future__ import annotations

import pytest

from ballfg.diagnosis.design.choice import combinations, parse_levels


def test_levels_and_their_combinations() -> None:
    levels = parse_levels("topspin=-1..1, wheel=900..1300:200,speed=0.5")
    assert levels == {"topspin": [-1.0, 0.0, 1.0], "wheel": [900.0, 1100.0, 1300.0], "speed": [0.5]}
    grid = combinations(levels)
    assert grid.shape == (9, 3)
    assert grid[1].tolist() == [-1.0, 1100.0, 0.5]
    assert parse_levels("a=0..0.3:0.1")["a"] == pytest.approx([0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("topspin", "must read NAME=LEVEL"),
        ("topspin=a..b", "got 'topspin=a..b'"),
        ("topspin=3..1", "got 'topspin=3..1'"),
        ("topspin=1..3:0", "got 'topspin=1..3:0'"),
        ("a=1,a=2", "got 'a' twice"),
        ("a=0..99,b=0..99", "at most 5000 combinations; got 10000"),
        ("a=0..1:1e-9", "a alone has more"),
    ],
)
def test_texts_with_mistakes(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_levels(text)
