"""The choice of shots against all possible choices, and against closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ballfg.diagnosis.design.choice import choose
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
