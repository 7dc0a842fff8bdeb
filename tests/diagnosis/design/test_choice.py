"""The choice of shots against all possible choices, and against closed forms; candidate settings from a text."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ballfg.diagnosis.design.choice import choose, combinations, parse_levels
from ballfg.diagnosis.design.information import Information

NAMES = ("a.x", "a.y", "b.z")


def random_information(seed: int, candidates: int = 9, known: float = 0.3) -> Information:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((candidates, 2, 3))
    shots = rows.swapaxes(1, 2) @ rows
    return Information(NAMES, np.array((0.1, 2.0, 1.0)), known * np.eye(3), shots, np.arange(candidates))


def error_of(information: Information, chosen: tuple[int, ...], sides: list[list[int]]) -> float:
    covariance = np.linalg.inv(information.known + information.shots[list(chosen)].sum(axis=0))
    return float(np.mean([np.linalg.slogdet(covariance[np.ix_(s, s)])[1] / (2 * len(s)) for s in sides]))


@pytest.mark.parametrize("seed", range(6))
def test_no_choice_is_much_better(seed: int) -> None:
    """Of all 495 choices of four shots out of nine with repetition."""
    information, sides = random_information(seed), [["a.x", "a.y"], ["b.z"]]
    choice = choose(information, sides, NAMES, 4, 0)
    every = [
        error_of(information, chosen, [[0, 1], [2]]) for chosen in itertools.combinations_with_replacement(range(9), 4)
    ]
    assert np.log(choice.error[-1]) == pytest.approx(error_of(information, tuple(choice.shots), [[0, 1], [2]]))
    assert np.log(choice.error[-1]) < min(every) + 0.02
    assert (np.diff(choice.error) <= 1e-12).all()


def test_one_coefficient_of_independent_shots() -> None:
    """Shots of information 1 and 4: the second one is chosen, 1/sigma^2 is 1 + 4 k, and of random shots 1 + 2.5 r."""
    shots = np.array((1.0, 4.0)).reshape(2, 1, 1)
    information = Information(("a.x",), np.array((0.5,)), np.ones((1, 1)), shots, np.arange(2))
    choice = choose(information, [["a.x"]], ["a.x"], 5, 3)
    assert choice.shots == [1] * 5
    np.testing.assert_allclose(choice.sigmas[:, 0], 0.5 / np.sqrt(1.0 + 4.0 * np.arange(6)))
    assert choice.as_random == pytest.approx(8.0)
    assert (choice.random[1:] >= choice.error[1:]).all()


def test_the_seed_changes_the_comparison_only() -> None:
    information = random_information(1)
    one, same, other = (choose(information, [["a.x"], ["b.z"]], NAMES, 3, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.random, same.random)
    assert one.shots == other.shots
    assert (one.random != other.random).any()


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
