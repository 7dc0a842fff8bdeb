"""Percentiles in bounded memory against numpy's over all values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ballfg.live.session import Latencies


def test_percentiles_are_right_to_a_bin() -> None:
    values = np.random.default_rng(0).lognormal(1.0, 1.0, 20000)
    latencies = Latencies()
    for value in values:
        latencies.add(value)
    for share in (0.5, 0.99, 0.999):
        exact = np.quantile(values, share, method="inverted_cdf")
        assert exact <= latencies.percentile(share) <= exact * 10 ** (1 / 200)
    assert latencies.percentile(1.0) == latencies.worst == values.max()
    assert latencies.count == len(values)


@pytest.mark.parametrize("value", [0.0, 1e9])
def test_what_lies_outside_of_the_scale_is_counted(value: float) -> None:
    latencies = Latencies()
    assert math.isnan(latencies.percentile(0.5))
    assert str(latencies) == "no line was answered with a state"
    latencies.add(value)
    assert latencies.percentile(0.5) <= max(value, 1e-3)
    assert latencies.worst == value
