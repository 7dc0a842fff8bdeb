"""The estimate goes with the frame it is made in: shifts in space and time, rotation about the vertical, factor order.

Tolerances are in posterior standard deviations. The minimisation stops within 1e-6 of them (its last Gauss-Newton step
is not taken); a contact's search adds its own 1e-13 s. So 1e-5, 1e-8 m, is what a moved problem, whose iterates round
differently, can promise. The priors move along: that of the first position lies about its measurement, those of
velocity and spin are isotropic about zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate
from ballfg.tracks import Track

MODEL = nominal_model()
SETTINGS = Settings.for_measured(MODEL, position_noise=(0.003,) * 3, spin_label_noise=4.0)
TOLERANCE = 1e-5


@pytest.fixture(scope="module", params=[0, 1, 2])
def track(request) -> Track:
    config = SimulationConfig(tracks=3, seed=31, noise=MeasurementNoise(position=0.003, dropout=0.1, outliers=0.01))
    return list(simulate(config))[request.param].track


def estimate(track: Track, table_height: float = 0.76) -> Estimate:
    return Smoother(MODEL, Surfaces.table_tennis(table_height), SETTINGS).estimate(track)


def turned(track: Track, R: np.ndarray) -> Track:
    spin = R @ track.spin_label
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), spin.tolist(), strict=True))
    return Track(track.times, track.positions @ R.T, labels=labels, name=track.name)


def off(given: Estimate, states: np.ndarray, reference: Estimate) -> float:
    return float(np.abs((given.states - states) / reference.sigmas).max())


@pytest.mark.parametrize("shift", [(3.0, -7.0, 0.0), (100.0, 50.0, -2.0)])
def test_shift(track, shift) -> None:
    """100 m away a coordinate has 2e-14 m of rounding: nothing."""
    base = estimate(track)
    moved = estimate(replace(track, positions=track.positions + shift), 0.76 + shift[2])
    expected = base.states.copy()
    expected[:, :3] += shift
    assert off(moved, expected, base) < TOLERANCE
    np.testing.assert_allclose(moved.sigmas, base.sigmas, rtol=1e-5)
    np.testing.assert_allclose(moved.whitened, base.whitened, atol=TOLERANCE)


@pytest.mark.parametrize("angle", [0.3, np.pi / 2, 2.5])
def test_rotation_about_the_vertical(track, angle) -> None:
    """Stamp jitter in the segmentation depends on the axes a little: the events found must be the same ones."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    base, rotated = estimate(track), estimate(turned(track, R))
    assert [k.interval for k in rotated.contacts] == [k.interval for k in base.contacts]
    np.testing.assert_array_equal(rotated.quality, base.quality)
    whole = np.kron(np.eye(3), R)
    sigma = np.sqrt(np.diagonal(rotated.covariances, axis1=1, axis2=2))
    assert np.abs((rotated.states - base.states @ whole.T) / sigma).max() < TOLERANCE
    unit = sigma[:, :, None] * sigma[:, None, :]
    assert np.abs((rotated.covariances - whole @ base.covariances @ whole.T) / unit).max() < 1e-4
    np.testing.assert_allclose(rotated.nis, base.nis, atol=1e-4)


def test_time_shift(track) -> None:
    """1000 s later a stamp has 1e-13 s of rounding, 5e-13 m of a ball's path; a dt loses 1e-11 of itself."""
    base = estimate(track)
    later = estimate(replace(track, times=track.times + 1000.0))
    assert off(later, base.states, base) < TOLERANCE
    shifted = [contact.time - 1000.0 for contact in later.contacts]
    np.testing.assert_allclose(shifted, [contact.time for contact in base.contacts], atol=1e-8)


def test_order_of_factors(track) -> None:
    smoother = Smoother(MODEL, Surfaces.table_tennis(0.76), SETTINGS)
    segmentation = smoother.segment(track)
    solution = smoother.settle(smoother.problem(track, segmentation))
    values = solution.minimum.values
    start = Values(values.states + np.repeat((1e-3, 1e-2, 1.0), 3), values.coefficients)
    minima = [
        LevenbergMarquardt().minimize(BallGraph(kinds), start)
        for kinds in (solution.graph.batches, solution.graph.batches[::-1])
    ]
    sigma = smoother.estimate(track).sigmas
    assert np.abs((minima[0].values.states - minima[1].values.states) / sigma).max() < TOLERANCE
    assert minima[0].error == pytest.approx(minima[1].error, rel=1e-10)


def test_the_same_track_gives_the_same_bytes(track) -> None:
    first, second = estimate(track), estimate(track)
    assert first.states.tobytes() == second.states.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()
