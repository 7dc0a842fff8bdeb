"""Settings for which both ways of a smoother are tried."""

from __future__ import annotations

import pytest

from ballfg.estimation.settings import Settings
from tests.estimation.smoother.serve import EXACT, UNCERTAIN


@pytest.fixture(params=[EXACT, UNCERTAIN], ids=["exact", "uncertain"])
def settings(request) -> Settings:
    return request.param
