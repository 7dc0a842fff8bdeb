import numpy as np
import pytest

from ballfg.benchmarks.diagnosis.ideal import power_curve


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
