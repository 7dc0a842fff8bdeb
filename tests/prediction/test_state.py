"""The parts of a state, and what a belief makes of its coefficients."""

from __future__ import annotations

import numpy as np

from ballfg.dynamics import Architecture, build
from ballfg.prediction import BallState, Belief

MEAN = np.array([0.1, 0.2, 0.3, 4.0, -5.0, 6.0, 70.0, -80.0, 90.0])


def test_a_state_by_its_parts() -> None:
    joint = np.diag(np.arange(1.0, 11.0) ** 2)
    state = BallState(0.5, np.append(MEAN, 0.13), joint, ("flight.drag.k",))
    np.testing.assert_array_equal(state.state, MEAN)
    np.testing.assert_array_equal(state.position, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(state.velocity, [4.0, -5.0, 6.0])
    np.testing.assert_array_equal(state.spin, [70.0, -80.0, 90.0])
    np.testing.assert_array_equal(state.sigmas, np.arange(1.0, 10.0))


def test_a_coefficient_without_bounds_stays_as_it_was_estimated() -> None:
    """A learned model declares none for its gravity: neither a low nor a high one moves anything."""
    model = build(Architecture.of("mnn+gs"), radius=0.02)
    assert "flight.bias" not in model.declared_coefficients()
    for gravity in (-1e3, 0.0, 1e3):
        mean = np.append(MEAN, gravity)
        belief = Belief.of(model, [BallState(0.0, mean, np.eye(10) + 0.1, ("flight.bias",))])
        np.testing.assert_array_equal(belief.mean[0], mean)
