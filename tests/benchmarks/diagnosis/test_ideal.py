"""The ideal test against simulated statistics and against refits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.diagnosis.cases import PLANTS, Recording
from ballfg.benchmarks.diagnosis.ideal import (
    LEVEL,
    Ideal,
    fit_declared,
    ideal_case,
    ideal_of,
    needed,
    power,
    power_curve,
)
from ballfg.diagnosis.hypotheses.signatures import visible_directions


@pytest.mark.parametrize("rank", [1, 3])
def test_ideal_power_is_that_of_simulated_statistics(rank: int) -> None:
    rng = np.random.default_rng(rank)
    draws = rng.standard_normal((400_000, rank))
    threshold = np.quantile((draws**2).sum(axis=1), 1.0 - LEVEL)
    draws[:, 0] += np.sqrt(needed(rank))
    assert ((draws**2).sum(axis=1) > threshold).mean() == pytest.approx(0.9, abs=0.01)
    assert power(0.0, rank) == pytest.approx(LEVEL)


def test_ideal_size_and_power_belong_together() -> None:
    ideal = Ideal("", 2, 450.0)
    assert ideal.power(ideal.size) == pytest.approx(0.9)
    assert ideal.size == pytest.approx(2.0 * Ideal("", 2, 1800.0).size)
    unseen = Ideal("", 0, 0.0)
    assert unseen.size == np.inf
    assert (unseen.power([1.0, 2.0]) == 0.0).all()


def test_visible_counts_directions() -> None:
    information = np.diag([4.0, 1.0, 0.0])
    assert visible_directions(information, np.array([4.0, 100.0, 5.0])).shape == (3, 2)
    assert visible_directions(np.ones((2, 2)), np.ones(2)).shape == (2, 1)
    assert visible_directions(np.zeros((2, 2)), np.zeros(2)).shape == (2, 0)


@pytest.mark.parametrize(("name", "size"), [("wind", 0.1), ("restitution_speed", 0.2)])
def test_noncentrality_is_what_the_declared_model_leaves_of_exact_tracks(name: str, size: float) -> None:
    """Twice the objective at its minimum, on tracks without noise in which the effect acts a little."""
    few = replace(ideal_case(name, 0), recording=Recording(tracks=5, position=0.0, spin=0.0))
    acting = replace(few, sessions=(PLANTS[name].texts(size),))  # the same launches
    assert 2.0 * fit_declared(acting).cost == pytest.approx(size**2 * ideal_of(few).information, rel=0.05)


def test_ideal_is_kept(tmp_path: Path) -> None:
    ideal, path = Ideal("of this case", 3, 12.5), tmp_path / "ideal-wind.json"
    ideal.save(path)
    assert Ideal.read(path, "of this case") == ideal
    assert Ideal.read(path, "of another") is None
    assert Ideal.read(tmp_path / "absent.json", "any") is None
    path.write_text("[]")
    with pytest.raises(ValueError, match=r"ideal-wind.json: must be an ideal test .* Delete it"):
        Ideal.read(path, "any")


def test_power_curve_recovers_the_one_that_made_the_outcomes() -> None:
    rng = np.random.default_rng(1)
    sizes = np.repeat([0.5, 0.8, 1.0, 1.5, 2.0, 3.0], 400)
    outcomes = rng.random(len(sizes)) < 1.0 / (1.0 + (sizes / 1.2) ** -4.0)
    curve = power_curve(sizes.tolist(), outcomes.tolist())
    assert np.exp(curve.middle) == pytest.approx(1.2, rel=0.05)
    assert curve.slope == pytest.approx(4.0, rel=0.1)
    assert curve.limit == pytest.approx(1.2 * 9.0**0.25, rel=0.05)  # odds of 9 are 90 %
    assert curve.at(curve.limit) == pytest.approx(0.9)


def test_limit_of_outcomes_that_part_cleanly_lies_where_they_part() -> None:
    sizes = [1.0] * 5 + [1.5] * 5 + [2.0] * 5 + [3.0] * 5
    curve = power_curve(sizes, [False] * 10 + [True] * 10)
    assert 1.5 < np.exp(curve.middle) < 2.0 <= curve.limit < 2.3


def test_limits_that_the_sizes_do_not_reach() -> None:
    sizes = [1.0, 1.5, 2.0, 3.0] * 5
    assert power_curve(sizes, [True] * 20).limit == 1.0
    assert power_curve(sizes, [False] * 20).limit == np.inf
