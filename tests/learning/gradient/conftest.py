"""What the tests of gradients through estimates share."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.learning.estimates import SETTINGS, Estimates, launcher, measured, usual_ball
from tests.learning.gradient.outer_loss import TRUTH


@pytest.fixture(scope="module")
def analytic() -> Estimates:
    return Estimates(usual_ball(), measured(TRUTH), replace(SETTINGS, launcher=launcher()))
