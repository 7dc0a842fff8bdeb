"""Every kind of factors against central differences of its own residuals, where residuals are not zero.

Tolerance 1e-6 relative; `conftest.differences` states the step and why it is good to 1e-9. What is seen, 1e-7 of a
block and up to 9e-7 of a row, in gaps of 0.4 s with two contacts, does not change with the step: the saltation
term takes the true rate at the contact; the discrete flight's differs by the integration's own error.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics.motion.contact import fly_through
from ballfg.factors.batch import COEFFICIENTS, Values
from ballfg.factors.dynamics import ContactFactors, FlightFactors, RestFactors
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import PriorFactors, coefficient_prior, spin_prior, state_prior

NOISE = ProcessNoise(contact_tangential=0.2, contact_spin=10.0)
TOLERANCE = 1e-6


def off(values: Values, seed: int = 0) -> Values:
    """The same states moved by some standard deviations of everything, so that no residual is zero."""
    rng = np.random.default_rng(seed)
    scale = np.repeat((2e-3, 2e-2, 3.0), 3)
    return Values(values.states + scale * rng.standard_normal(values.states.shape), values.coefficients)


def flight_states(n: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low = np.array([-1.0, -0.5, 0.3, 2.0, -2.0, -3.0, -150.0, -300.0, -150.0])
    high = np.array([1.0, 0.5, 0.6, 8.0, 2.0, 3.0, 150.0, 300.0, 150.0])
    return rng.uniform(low, high, (n, 9))


@pytest.fixture(params=["plain", "augmented"])
def case(request, model, augmented, coefficients):
    """A model and the coefficients that it takes from the values."""
    return (model, np.zeros(0)) if request.param == "plain" else (augmented, coefficients)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 3.0), Loss("cauchy", 3.0)], ids=lambda loss: loss.name)
def test_position(loss, check_jacobian) -> None:
    rng = np.random.default_rng(0)
    values = Values(flight_states(3), np.zeros(0))
    measured = values.states[:, :3] + 0.01 * rng.standard_normal((3, 3))
    kind = PositionFactors(np.arange(3), measured, rng.uniform(0.001, 0.01, (3, 3)), loss)
    assert check_jacobian(kind, values) < TOLERANCE


def test_priors(check_jacobian) -> None:
    rng = np.random.default_rng(0)
    values = Values(flight_states(3), rng.standard_normal(2))
    assert check_jacobian(state_prior(1, np.ones(9), rng.uniform(0.1, 9.0, 9)), values) < TOLERANCE
    spins = spin_prior(np.array([0, 2]), np.full((2, 3), 7.0), rng.uniform(1.0, 9.0, (2, 3)), Loss("cauchy"))
    assert check_jacobian(spins, values) < TOLERANCE
    assert check_jacobian(coefficient_prior(np.full(2, 5.0), np.array([0.1, 2.0])), values) < TOLERANCE
    full = PriorFactors(np.array([0, 2]), np.zeros((2, 9)), rng.standard_normal((2, 4, 9)))
    assert check_jacobian(full, values) < TOLERANCE


def test_priors_look_at_their_own_columns() -> None:
    values = Values(np.arange(18.0).reshape(2, 9), np.array([3.0, 4.0]))
    spin = spin_prior(np.array([1]), np.array([[15.0, 16.0, 15.0]]), np.array([[1.0, 2.0, 4.0]])).linearize(values)
    np.testing.assert_allclose(spin.residual, [[0.0, 0.0, 0.5]])
    prior = coefficient_prior(np.array([1.0, 1.0]), np.array([2.0, 3.0])).linearize(values)
    np.testing.assert_allclose(prior.residual, [[1.0, 1.0]])
    assert prior.variables.tolist() == [[COEFFICIENTS]]


@pytest.mark.parametrize("dt", [0.004, 0.01, 0.2])
def test_flight(dt, case, check_jacobian) -> None:
    model, coefficients = case
    times = np.array([dt, 1.3 * dt])
    kind = FlightFactors(model, np.array([0, 1]), times, NOISE.flight(times))
    assert check_jacobian(kind, off(Values(flight_states(3), coefficients))) < TOLERANCE


def test_hit(case, check_jacobian) -> None:
    model, coefficients = case
    dt = np.array([0.01])
    kind = FlightFactors(model, np.array([0]), dt, NOISE.flight(dt) + NOISE.hit(dt))
    states = flight_states(2)
    states[1, 3:6] = -states[0, 3:6]
    assert check_jacobian(kind, Values(states, coefficients)) < TOLERANCE


def bouncing_states(model, coefficients, start, dt: float, heights) -> tuple[Values, np.ndarray]:
    """States before and after an interval with contacts, each pair next to one another."""
    before = torch.tensor(start, dtype=torch.float64)
    extended = model.append(before, torch.from_numpy(coefficients)) if len(coefficients) else before
    with torch.no_grad():
        after, times = fly_through(model, extended, torch.full((len(start),), dt, dtype=torch.float64), heights)
    pairs = np.stack((before.numpy(), after.numpy()[:, :9]), axis=1).reshape(-1, 9)
    return Values(pairs, coefficients), times.numpy()


# slides, slides, grips with some spin, blends; on the table (0.02 - 0.004 m up) and, for the second, from higher up
STARTS = [
    [0.0, 0.0, 0.03, 5.0, 0.5, -2.0, 10.0, -150.0, 30.0],
    [0.3, 0.1, 0.05, 4.0, -1.0, -3.5, -40.0, 20.0, 60.0],
    [0.3, 0.1, 0.04, 1.0, -0.3, -3.0, -20.0, 40.0, 60.0],
    [0.1, -0.1, 0.03, 2.5, -0.2, -2.5, -20.0, 40.0, -60.0],
]


def test_contact(case, check_jacobian) -> None:
    model, coefficients = case
    values, times = bouncing_states(model, coefficients, STARTS, 0.02, (0.0,))
    assert (times > 0).all()
    assert (times < 0.02).all()
    dt = np.full(4, 0.02)
    states = 2 * np.arange(4)
    kind = ContactFactors(model, states, dt, NOISE.flight(dt) + NOISE.contact(dt, times[:, 0]), np.zeros((4, 1)))
    moved = off(values)
    assert check_jacobian(kind, moved) < TOLERANCE
    np.testing.assert_allclose(kind.contact_times(values), times, atol=1e-12)


def test_contact_outside_its_interval(case, check_jacobian) -> None:
    """A contact a little before or after the interval is a smooth continuation; the optimiser passes through it."""
    model, coefficients = case
    start = [[*STARTS[0][:2], 0.08, *STARTS[0][3:]], [*STARTS[1][:2], 0.012, *STARTS[1][3:]]]
    values, times = bouncing_states(model, coefficients, start, 0.01, (0.0,))
    assert times[0, 0] > 0.01
    assert times[1, 0] < 0
    dt = np.full(2, 0.01)
    kind = ContactFactors(
        model, np.array([0, 2]), dt, NOISE.flight(dt) + NOISE.contact(dt, times[:, 0]), np.zeros((2, 1))
    )
    assert check_jacobian(kind, off(values)) < TOLERANCE


def test_two_contacts(case, check_jacobian) -> None:
    """Down, a low hop, down again, within one gap in the data."""
    model, coefficients = case
    start = [[0.0, 0.0, 0.03, 3.0, 0.5, -0.6, 10.0, -50.0, 30.0], [0.0, 0.2, 0.025, 1.5, -0.5, -0.4, 10.0, 20.0, 30.0]]
    values, times = bouncing_states(model, coefficients, start, 0.2, (0.0, 0.0))
    assert (np.diff(times, axis=1) > 0.03).all()
    assert (times < 0.2).all()
    dt = np.full(2, 0.2)
    covariance = NOISE.flight(dt) + NOISE.contact(dt, times[:, 0]) + NOISE.contact(dt, times[:, 1])
    kind = ContactFactors(model, np.array([0, 2]), dt, covariance, np.zeros((2, 2)))
    assert check_jacobian(kind, off(values)) < TOLERANCE


def test_two_surfaces(case, check_jacobian) -> None:
    """Rows of one kind may name different surfaces, and one row two of them."""
    model, coefficients = case
    start = [[0.0, 0.0, 0.03, 3.0, 0.5, -0.6, 10.0, -50.0, 30.0], [0.0, 0.2, -0.735, 1.5, -0.5, -0.4, 10.0, 20.0, 30.0]]
    heights = np.array([[0.0, -0.3], [-0.76, -0.76]])
    columns = tuple(torch.from_numpy(column) for column in heights.T.copy())
    values, times = bouncing_states(model, coefficients, start, 0.4, columns)
    dt = np.full(2, 0.4)
    covariance = NOISE.flight(dt) + NOISE.contact(dt, times[:, 0]) + NOISE.contact(dt, times[:, 1])
    kind = ContactFactors(model, np.array([0, 2]), dt, covariance, heights)
    assert check_jacobian(kind, off(values)) < TOLERANCE


def test_rest(case, check_jacobian) -> None:
    model, coefficients = case
    states = flight_states(3)
    states[:, 2] = 0.016
    states[:, 5] = 0.02
    states[1:, 2] += (0.01, -0.003)
    dt = np.array([0.01, 0.05])
    kind = RestFactors(model, np.array([0, 1]), dt, NOISE.flight(dt), np.zeros(2))
    assert check_jacobian(kind, Values(states, coefficients)) < TOLERANCE


def test_rows_of_a_batch_are_rows_by_themselves(case) -> None:
    """compute(rows) is what compute of all says there: a batch never mixes its factors."""
    model, coefficients = case
    values, times = bouncing_states(model, coefficients, STARTS, 0.02, (0.0,))
    dt = np.full(4, 0.02)
    kinds = [
        ContactFactors(
            model, 2 * np.arange(4), dt, NOISE.flight(dt) + NOISE.contact(dt, times[:, 0]), np.zeros((4, 1))
        ),
        FlightFactors(model, np.arange(5), np.linspace(0.004, 0.01, 5), NOISE.flight(np.linspace(0.004, 0.01, 5))),
        RestFactors(model, np.arange(3), dt[:3], NOISE.flight(dt[:3]), np.zeros(3)),
        PositionFactors(np.arange(4), values.states[:4, :3] + 0.1, np.full((4, 3), 0.01)),
    ]
    for kind in kinds:
        whole = kind.linearize(values)
        rows = np.array([2, 0])
        inputs = tuple(values.gather(column)[rows] for column in kind.variables.T)
        residual, jacobians = kind.compute(rows, inputs)
        np.testing.assert_allclose(residual, whole.residual[rows], rtol=1e-9, atol=1e-9)
        for block, expected in zip(jacobians, whole.jacobians, strict=True):
            np.testing.assert_allclose(block, expected[rows], rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_a_bad_argument_is_named(model) -> None:
    one, three = np.array([1.0]), np.ones((1, 3))
    with pytest.raises(ValueError, match="dt must be positive"):
        FlightFactors(model, np.array([0]), -one, NOISE.flight(one))
    with pytest.raises(ValueError, match="measured and sigma must have shape"):
        PositionFactors(np.array([0]), np.ones(3), three)
    with pytest.raises(ValueError, match="measured must be finite"):
        PositionFactors(np.array([0]), np.nan * three, three)
    with pytest.raises(ValueError, match="sigma positive"):
        PositionFactors(np.array([0]), three, 0 * three)
    with pytest.raises(ValueError, match="sigma must be positive and finite"):
        state_prior(0, np.zeros(9), np.zeros(9))
    with pytest.raises(ValueError, match="sigma must be positive and finite"):
        coefficient_prior(np.zeros(1), np.array([np.inf]))
