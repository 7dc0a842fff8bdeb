"""What the tests of the filters share."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from tests.estimation.filters.filtering import PLAIN, SERVE, simulate


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def flight(rng):
    """A simulated track of 60 samples at 100 Hz, and its truth; it bounces near 0.37 s."""
    return simulate(nominal_model(), PLAIN, SERVE, np.arange(60) * 0.01, rng)
