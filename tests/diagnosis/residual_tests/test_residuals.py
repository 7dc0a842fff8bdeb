"""What a fit leaves, against planted forces and kicks, and against differences of shot trajectories."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from ballfg.diagnosis.fit.patterns import since_contact
from ballfg.diagnosis.fit.response import ACCELERATION, BIN, fitted_path, responses, weighted
from ballfg.diagnosis.fit.shooting import shoot
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import hypothesis_columns
from ballfg.diagnosis.residual_tests.residuals import residuals_of
from ballfg.dynamics.effect import Flight
from ballfg.dynamics.effects.generic import (
    MOTION_TERMS,
    PLACE_TERMS,
    GenericContact,
    GenericFlight,
    flight_axes,
    motion_terms,
    place_terms,
)

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # torch's own
TRACKS = 10


@pytest.fixture(scope="module")
def fixed_fit(make_known_ball, make_known_fit, make_launches, make_shots):
    """The fit of a ball with nothing free to tracks of a ball that has further effects."""

    def fit_of(*effects, bounces=True):
        starts = make_launches(TRACKS, 7)
        if not bounces:
            starts[:, 5] += 5.0
        return make_known_fit(make_shots(make_known_ball(*effects), starts, 7).stretches)

    return fit_of


@pytest.fixture(scope="module")
def plain(fixed_fit):
    return fixed_fit()


@pytest.fixture(scope="module")
def left(plain):
    return residuals_of(plain)


def test_answers_to_forces_are_the_derivatives_by_the_generic_effect(plain):
    strengths = tuple(c.name for c in GenericFlight.coefficients if c.absent is not None)
    wanted = hypothesis_columns(plain, [Hypothesis(GenericFlight, {}, strengths)])
    found = np.zeros_like(wanted)
    centre, reference = torch.tensor((1.4, 0.0, 1.0), dtype=torch.float64), torch.tensor(5.0, dtype=torch.float64)
    for arc in responses(plain):
        flight = Flight(torch.from_numpy(arc.nodes), 0.02)
        axes, place = flight_axes(flight.velocity), flight.position - centre
        world = torch.einsum("ac,mqt->mqcat", torch.eye(3, dtype=torch.float64), place_terms(place))
        own = torch.einsum("mqac,mqt->mqcat", axes, motion_terms(flight, axes, place, reference))
        assert (world.shape[-1], own.shape[-1]) == (len(PLACE_TERMS), len(MOTION_TERMS))
        found[arc.rows] += weighted(
            plain, arc.response_to(torch.cat((world.flatten(-2), own.flatten(-2)), -1).numpy()), arc.rows
        )
    # nodes 10 ms apart: the midpoint rule's error, largest where the term changes fastest
    assert (np.abs(found - wanted).max((0, 1)) / np.abs(wanted).max((0, 1))).max() < 1e-3


def test_kicks_move_later_samples_as_a_shot_from_there_does(plain):
    path, stretches = fitted_path(plain), plain.problem.stretches
    arc = path.motion.arcs[1]
    (after,) = (found for found in responses(plain) if found.number == 1)
    step, rows = 1e-4, arc.rows
    since, heights = path.times[:, rows] - arc.begun, stretches.heights[rows, 1:]
    guesses = path.motion.contacts[rows, 1:] - arc.begun[:, None]
    for direction in range(6):
        kick = step * torch.eye(9, dtype=torch.float64)[3 + direction]
        moved = [shoot(plain.problem.model, arc.nodes[0] + k, heights, guesses, since[-1]) for k in (kick, -kick)]
        difference = (moved[0].states(since) - moved[1].states(since))[..., :3] / (2 * step)
        wanted = torch.where(since.unsqueeze(-1) >= 0.0, difference, 0.0).transpose(0, 1).numpy()
        # central differences: third derivatives times step^2, and contact times to 1e-12 s over the step
        np.testing.assert_allclose(after.kicks[..., direction], wanted, atol=1e-6)


def test_bins_are_about_as_long_as_stated_and_never_reach_across_a_contact(plain, left):
    end = float(plain.problem.stretches.times[0, -1])
    for row in range(TRACKS):
        times = left.flight.times[left.flight.stretch == row]
        edges = (0.0, *left.contact.times[left.contact.stretch == row], end)
        for begin, end in itertools.pairwise(edges):
            inside = times[(times > begin) & (times < end)]
            assert len(inside) == max(1, round((end - begin) / BIN))
            np.testing.assert_allclose(inside[0] - begin, end - inside[-1], atol=1e-9)


def test_without_cause_residuals_are_within_their_covariance(left):
    for found, covariance in (
        (left.flight.acceleration, left.flight.covariance),
        (np.concatenate((left.contact.velocity, left.contact.spin), axis=1), left.contact.covariance),
    ):
        square = np.einsum("mi,mij,mj->m", found, np.linalg.inv(covariance), found) / found.shape[1]
        assert square.mean() < 1.5  # a posterior mean is smaller than its error where the prior rules
    # what a whole bin of 40 ms may hold before anything is known of it, or less
    variance = np.diagonal(left.flight.covariance, axis1=1, axis2=2)
    assert np.median(variance) < ACCELERATION**2 / BIN


def test_planted_acceleration_is_what_the_fit_invents(fixed_fit):
    found = residuals_of(fixed_fit(GenericFlight(y_one=0.5, z_one=-0.3))).flight
    means = np.array([found.acceleration[found.stretch == row].mean(axis=0) for row in range(TRACKS)])
    error = means.std(axis=0, ddof=1) / np.sqrt(TRACKS)
    assert (error < 0.1).all()
    share = (means.mean(axis=0) / (1.0, 0.5, -0.3))[1:]
    spread = error[1:] / (0.5, 0.3)
    assert abs(means.mean(axis=0)[0]) < 4.0 * error[0]
    # damped by the prior, by a sixth to a third on arcs as short as these
    np.testing.assert_array_less(0.66 - 3.0 * spread, share)
    np.testing.assert_array_less(share, 1.0 + 3.0 * spread)


def test_planted_kick_is_found_at_the_contact(fixed_fit):
    fitted = fixed_fit(GenericContact(z_one=0.2, y_one=0.1))
    found = residuals_of(fitted).contact
    error = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3].mean(axis=0) / len(found.times))
    # no friction in this ball: sideways all of it goes through, vertically times the restitution
    wanted = (0.0, 0.1, -0.2 * float(fitted.problem.model.bounce["restitution"].e))
    assert error.max() < 0.05
    np.testing.assert_array_less(np.abs(found.velocity.mean(axis=0) - wanted), 4.0 * error)
    assert (found.incoming[:, 5] < -1.0).all()


def test_measurement_residuals_are_measured_minus_fitted(plain, left):
    count = plain.problem.stretches.times.shape[1]
    found = left.measurement
    assert found.position.shape == (TRACKS * count, 3)
    difference = plain.problem.stretches.positions.numpy() - plain.predicted.positions
    np.testing.assert_array_equal(found.position, difference.reshape(-1, 3))
    np.testing.assert_allclose(
        found.states[:, :3] + found.position, plain.problem.stretches.positions.reshape(-1, 3), atol=1e-9
    )
    np.testing.assert_array_equal(found.sigma, plain.sigmas.reshape(-1, 3))
    assert left.names == plain.problem.stretches.names


def test_flights_without_contacts(fixed_fit):
    fitted = fixed_fit(bounces=False)
    found, end = residuals_of(fitted), float(fitted.problem.stretches.times[0, -1])
    assert found.contact.velocity.shape == (0, 3)
    assert found.contact.covariance.shape == (0, 6, 6)
    assert np.isnan(found.measurement.since_contact).all()
    assert len(found.flight.times) == TRACKS * round(end / BIN)


def test_since_contact():
    times = np.array([[0.0, 0.1, 0.2, 0.5], [0.0, 0.1, 0.2, 0.3]])
    contacts = np.array([[0.15, 0.4], [0.1, np.nan]])
    wanted = [[np.nan, np.nan, 0.05, 0.1], [np.nan, 0.0, 0.1, 0.2]]
    np.testing.assert_allclose(since_contact(times, contacts), wanted)
