"""Gram-Schmidt representations: they are what the textbook says, turn and flip along, and are smooth everywhere."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.autograd.functional import hessian, jacobian

from ballfg.dynamics.networks.gram_schmidt import (
    CONTACT_FEATURES,
    CONTACT_SCALE,
    CONTACT_TERMS,
    FLIGHT_TERMS,
    LIFT,
    SPEED_SCALE,
    SPIN_SCALE,
    acceleration,
    angular_acceleration,
    contact_change,
    contact_frame,
    flight_frame,
)

RADIUS = 0.02
NO_BIAS = torch.zeros(3, dtype=torch.float64)


def random_orthogonal(dimension, mirror, seed):
    rng = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(dimension, dimension, generator=rng, dtype=torch.float64))
    if (torch.linalg.det(q) < 0) != mirror:
        q[:, 0] = -q[:, 0]
    return q


def turned(state, matrix):
    """Position, velocity and spin after a rotation or mirror; spin is a pseudovector."""
    position, velocity, spin = state.split(3, dim=-1)
    flip = torch.linalg.det(matrix)
    return torch.cat((position @ matrix.T, velocity @ matrix.T, flip * (spin @ matrix.T)), dim=-1)


def about_z(mirror, seed):
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2, :2] = random_orthogonal(2, mirror, seed)
    return matrix


def mixing(inputs, outputs, seed=0):
    """Coefficients that depend on features in some smooth way, in place of a network."""
    weights = torch.randn(inputs, outputs, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return lambda features: torch.sin(2 * features @ weights)


def flight(state):
    """(..., 6) rates that some coefficients give."""
    frame = flight_frame(state)
    linear, angular = mixing(3, 2 * FLIGHT_TERMS)(frame.features).split(FLIGHT_TERMS, dim=-1)
    return torch.cat((acceleration(frame, linear, NO_BIAS), angular_acceleration(frame, angular)), dim=-1)


def contact(state):
    """(..., 5) changes that some coefficients give, in m/s."""
    frame = contact_frame(state, RADIUS)
    velocity, spin = contact_change(frame, mixing(CONTACT_FEATURES, CONTACT_TERMS)(frame.features), RADIUS)
    return torch.cat((velocity, RADIUS * spin), dim=-1)


def textbook(vectors):
    """Lengths |q_k| and projections x_j . q_k / |q_k| of the Gram-Schmidt process, one state at a time."""
    first, second = vectors
    length = first.norm()
    along = second @ first / length
    return length, along, (second - along * first / length).norm()


def test_flight_features_are_those_of_gram_schmidt_with_a_lifted_velocity(states):
    zero = torch.zeros(1, dtype=torch.float64)
    for state in states(20):
        lifted = (torch.cat((state[3:6], zero + LIFT)), torch.cat((state[6:9], zero)))
        speed, along, across = textbook(lifted)
        expected = torch.stack((speed / SPEED_SCALE, along / SPIN_SCALE, across / SPIN_SCALE))
        assert torch.allclose(flight_frame(state).features, 1 / (1 + expected**2), rtol=1e-12, atol=0)
        plain = textbook((state[3:6], state[6:9]))
        assert torch.allclose(torch.stack((speed, along.abs(), across)), torch.stack(plain).abs(), rtol=0.02, atol=0.5)


def test_contact_features_are_those_of_gram_schmidt_with_a_lifted_slip(states):
    zero = torch.zeros(1, dtype=torch.float64)
    soft = zero + LIFT / CONTACT_SCALE
    for state in states(20):
        x, y, z, wx, wy, wz = (state[3:] / CONTACT_SCALE).tolist()
        slip = torch.tensor((x - RADIUS * wy, y + RADIUS * wx), dtype=torch.float64)
        velocity = torch.tensor((x, y), dtype=torch.float64)
        length, along, across = textbook((torch.cat((slip, soft)), torch.cat((velocity, zero))))
        turn = (slip[0] * velocity[1] - slip[1] * velocity[0]) / length
        raw = (length, math.hypot(across, soft), math.hypot(RADIUS * wz, soft), along, z, RADIUS * wz * turn)
        expected = torch.tensor([float(value) / math.sqrt(1 + float(value) ** 2) for value in raw], dtype=torch.float64)
        assert torch.allclose(contact_frame(state, RADIUS).features, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("mirror", [False, True])
def test_flight_turns_and_flips_along(states, mirror):
    state = states(50)
    for seed in range(5):
        matrix = random_orthogonal(3, mirror, seed)
        there = turned(state, matrix)
        assert torch.allclose(flight_frame(there).features, flight_frame(state).features, rtol=0, atol=1e-12)
        expected = torch.cat((flight(state)[..., :3] @ matrix.T, flight(state)[..., 3:] @ matrix.T), dim=-1)
        expected[..., 3:] *= torch.linalg.det(matrix)
        assert torch.allclose(flight(there), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("mirror", [False, True])
def test_contact_turns_and_flips_along(states, mirror):
    state = states(50)
    for seed in range(5):
        matrix = about_z(mirror, seed)
        there = turned(state, matrix)
        same = contact_frame(state, RADIUS).features
        assert torch.allclose(contact_frame(there, RADIUS).features, same, rtol=0, atol=1e-12)
        velocity, spin = contact(state).split((2, 3), dim=-1)
        expected = torch.cat((velocity @ matrix[:2, :2].T, torch.linalg.det(matrix) * (spin @ matrix.T)), dim=-1)
        assert torch.allclose(contact(there), expected, rtol=0, atol=1e-10)


def test_a_mirror_is_no_rotation(states):
    """Were spin taken for a vector, the Magnus term would point the wrong way."""
    state, matrix = states(5), random_orthogonal(3, True, 0)
    wrong = torch.cat([part @ matrix.T for part in state.split(3, dim=-1)], dim=-1)
    assert not torch.allclose(flight(wrong)[..., :3], flight(state)[..., :3] @ matrix.T, atol=0.1)


def test_vectors_span_space_and_plane(states):
    """Velocity and spin span a plane; the Magnus force leaves it."""
    state = states(50)
    frame = flight_frame(state)
    linear = [acceleration(frame, row.expand(50, 3), NO_BIAS) for row in torch.eye(3, dtype=torch.float64)]
    assert bool((torch.linalg.det(torch.stack(linear, dim=-1)).abs() > 1e-3).all())
    angular = [angular_acceleration(frame, row.expand(50, 3)) for row in torch.eye(3, dtype=torch.float64)]
    assert bool((torch.linalg.det(torch.stack(angular, dim=-1)).abs() > 1e-3).all())
    rows = torch.eye(CONTACT_TERMS, dtype=torch.float64)
    changes = [torch.cat(contact_change(contact_frame(state, RADIUS), row.expand(50, -1), RADIUS), -1) for row in rows]
    assert bool((torch.linalg.matrix_rank(torch.stack(changes, dim=-1)) == 5).all())


def test_drag_and_magnus_are_constant_coefficients_times_vectors(states):
    state = states(10)
    frame = flight_frame(state)
    coefficients = torch.tensor((-0.7, 0.0, 0.0028 * SPIN_SCALE), dtype=torch.float64).expand(10, 3)
    expected = -0.7 * state[:, 3:6] + 0.0028 * torch.linalg.cross(state[:, 6:9], state[:, 3:6])
    assert torch.allclose(acceleration(frame, coefficients, NO_BIAS), expected, rtol=1e-13, atol=1e-13)
    decay = torch.tensor((-0.2, 0.0, 0.0), dtype=torch.float64).expand(10, 3)
    assert torch.allclose(angular_acceleration(frame, decay), -0.2 * state[:, 6:9], rtol=1e-13, atol=1e-13)


DEGENERATE = {
    "nothing moves": (0, 0, 0, 0, 0, 0),
    "at rest with spin": (0, 0, 0, 20, -90, 40),
    "no spin": (4, 1, -2, 0, 0, 0),
    "parallel": (4, 1, -2, 80, 20, -40),
    "opposite": (4, 1, -2, -80, -20, 40),
    "straight down": (0, 0, -3, 0, 0, 70),
    "rolling: no slip": (3, 1, -2, -1 / RADIUS, 3 / RADIUS, 10),
    "slip along the velocity": (3, 1, -2, 1 / RADIUS, -3 / RADIUS, 10),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("function", [flight, contact])
def test_smooth_where_directions_vanish(function, name):
    """Value, gradient and Hessian are finite there, and those of a neighbour are near."""
    state = torch.cat((torch.zeros(3, dtype=torch.float64), torch.tensor(DEGENERATE[name], dtype=torch.float64)))
    near = state + 1e-8 * torch.tensor((1, 1, 1, 2, -3, 1, 20, 30, -10), dtype=torch.float64)

    def scalar(x: Tensor) -> Tensor:
        return function(x).sum()

    for here, there in (
        (scalar(state), scalar(near)),
        (jacobian(scalar, state), jacobian(scalar, near)),
        (hessian(scalar, state), hessian(scalar, near)),
    ):
        assert bool(here.isfinite().all())
        assert (here - there).abs().max() < 1e-4 + 1e-5 * here.abs().max()


@pytest.mark.parametrize("function", [flight, contact])
def test_derivatives(function, states):
    """Against differences with torch's step of 1e-6, at points on which nothing is special and on some that are."""
    special = torch.tensor([(0, 0, 0, *v) for v in DEGENERATE.values()], dtype=torch.float64)
    scale = torch.tensor([1.0] * 6 + [30.0] * 3, dtype=torch.float64)  # so that one step suits velocity and spin
    for batch in (states(2, seed=3), special[3:7]):
        x = (batch / scale).requires_grad_(True)
        assert torch.autograd.gradcheck(lambda x: function(x * scale), x, atol=1e-5)
        assert torch.autograd.gradgradcheck(lambda x: function(x * scale), x, atol=1e-4)
