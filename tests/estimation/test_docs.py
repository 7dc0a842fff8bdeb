"""The guides' examples run as they stand."""

import re

import numpy as np

import ballfg as bf
from ballfg.estimation.registry import ESTIMATORS
from tests.places import DOCS


def test_an_estimator_of_ones_own_is_used_by_name() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "estimators.md").read_text(encoding="utf-8"), re.DOTALL)
    times = np.arange(30) / 100
    path = np.outer(times, [3.0, 0.0, 1.0]) - np.outer(times**2, [0.0, 0.0, 4.9]) + [0.0, 0.0, 0.5]
    with ESTIMATORS.restored():
        exec(compile(code, "docs/estimators.md", "exec"), {"__name__": "example"})
        estimate = bf.estimate(bf.Track(times, path), method="raw")
    assert np.allclose(estimate.states[:, 0], 3.0 * times)
    assert estimate.predict(0.1).times[-1] > times[-1]
