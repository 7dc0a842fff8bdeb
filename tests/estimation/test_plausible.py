"""Absurd estimates: what leaves the package is finite, and a status says that it is no estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Settings, Smoother, Status
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track

MODEL = nominal_model()
SETTINGS = Settings.for_measured(MODEL, position_noise=(0.003,) * 3)


@pytest.fixture(scope="module")
def estimated() -> tuple[Track, Estimate]:
    track = next(iter(simulate(SimulationConfig(tracks=1, seed=4)))).track
    return track, Smoother(MODEL, Surfaces.table_tennis(0.0), SETTINGS).estimate(track)


def looked_at(estimated: tuple[Track, Estimate], **wrong: object) -> Estimate:
    track, estimate = estimated
    return plausible(replace(estimate, **wrong), track, np.full((len(track), 3), 0.003), SETTINGS)


def test_a_usual_estimate_stays_as_it_is(estimated: tuple[Track, Estimate]) -> None:
    found = looked_at(estimated)
    assert found.status is Status.OK
    np.testing.assert_array_equal(found.states, estimated[1].states)
    np.testing.assert_allclose(found.covariances, estimated[1].covariances, rtol=1e-12)
    np.testing.assert_array_equal(found.coefficients, estimated[1].coefficients)


def test_a_state_that_no_ball_has_becomes_its_measured_position(estimated: tuple[Track, Estimate]) -> None:
    states = estimated[1].states.copy()
    states[7, 3] = 1e5
    found = looked_at(estimated, states=states)
    assert found.status is Status.IMPLAUSIBLE
    np.testing.assert_array_equal(found.states[7], [*estimated[0].positions[7], *[0.0] * 6])
    np.testing.assert_array_equal(found.states[8], states[8])
    assert found.sigmas[7, 3] == pytest.approx(SETTINGS.velocity_prior)


@pytest.mark.parametrize("what", ["a coefficient", "a variance", "a covariance with the states"])
def test_coefficients_that_are_no_numbers_become_their_priors(estimated: tuple[Track, Estimate], what: str) -> None:
    """One of the three is enough."""
    _, estimate = estimated
    coefficients, own = estimate.coefficients.copy(), estimate.coefficient_covariance.copy()
    cross = estimate.cross_covariances.copy()
    if what == "a coefficient":
        coefficients[0] = np.nan
    elif what == "a variance":
        own[0, 0] = -1.0
    else:
        cross[3, 0, 0] = np.inf
    found = looked_at(estimated, coefficients=coefficients, coefficient_covariance=own, cross_covariances=cross)
    assert found.status is Status.IMPLAUSIBLE
    np.testing.assert_allclose(found.coefficient_covariance, np.diag(np.square(list(SETTINGS.coefficients.values()))))
    assert np.isfinite(found.coefficients).all()
    assert not found.cross_covariances.any()
