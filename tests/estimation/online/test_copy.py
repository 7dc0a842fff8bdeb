"""A copy of the online estimator goes its own way, and what it would have said is what the original says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Settings
from ballfg.estimation.settings import SOLVERS, Solver
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track


@pytest.fixture(scope="module")
def track() -> Track:
    (shot,) = simulate(SimulationConfig(tracks=1, rate=60.0, seed=3))
    return shot.track


@pytest.mark.parametrize("memory", [0.0, 0.002])
@pytest.mark.parametrize("solver", SOLVERS)
def test_going_back_gives_the_states_of_the_samples_in_order(track: Track, memory: float, solver: Solver) -> None:
    """Through bounces and cuts of the window, with other samples pushed into copies in between."""
    model = nominal_model()
    settings = replace(Settings.for_measured(model), memory=(memory,) * 3, stamp_jitter=0.05 * memory)
    live, straight = (Online(model, 0.0, replace(settings, solver=solver), lag=12) for _ in range(2))
    kept, since = live.copy(), 0
    for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
        expected = straight.push(time, position)
        live.push(time, position)
        if k % 9 != 8:
            continue
        astray = kept.copy()
        for j in range(since, k + 1):
            astray.push(track.times[j], track.positions[j] + 0.01 * (j - since))
        live = kept.copy()
        states = [live.push(track.times[j], track.positions[j]) for j in range(since, k + 1)]
        np.testing.assert_array_equal(states[-1].mean, expected.mean)
        np.testing.assert_array_equal(states[-1].joint, expected.joint)
        kept, since = live.copy(), k + 1
