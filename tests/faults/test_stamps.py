"""Nothing depends on where a clock began: some commands and calls with stamps from 0 and from 1.7e9 s."""

import numpy as np
import pytest

from tests.faults import stamps

ALLOWED = 1e-3
"""Standard deviations, or shares of a number without one."""
QUICK = (
    "ballfg predict --observe 0.25",
    "ballfg live --replay",
    "ballfg track DETECTIONS",
    "bf.estimate(folder)",
    "bf.predict(track), events ahead",
    "sightings: Smoother, push_sighting, time offsets",
    "RadarSpeed.at, bf.estimate",
)


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.thorough) for name in stamps.CASES if name not in QUICK)]
)
def test_results_do_not_depend_on_where_the_clock_began(name):
    worst, where = stamps.measured(name, tracks=3 if name in QUICK else 12, seed=3)  # a diagnosis needs six
    assert worst < ALLOWED, where


def test_differences_are_noticed():
    """By a thousandth of a sigma, in counts, in words, and where a stamp is off by more than doubles are apart."""
    early = {"x": np.zeros(2), "x.sigma": np.full(2, 0.1), "n": 3, "word": "flew", "t": np.array([0.0, 1.0])}
    late = {**early, "t": early["t"] + 10.0}
    assert stamps.difference(early, late, 10.0)[0] < 1e-9
    assert stamps.difference(early, late | {"x": np.full(2, 2e-4)}, 10.0) == (pytest.approx(2e-3), "x")
    assert stamps.difference(early, late | {"n": 4}, 10.0) == (0.25, "n")
    assert stamps.difference(early, late | {"word": "fell"}, 10.0) == (np.inf, "word")
    assert stamps.difference(early, late | {"t": late["t"] + [0.0, 1e-5]}, 10.0) == (pytest.approx(0.01), "t")
