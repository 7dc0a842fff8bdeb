"""What the covariances gain beside a contact: p (1 - p) d d' by hand, for a ball that only falls and bounces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.smoother.near_contact import other_sides

G, E = 9.81, 0.9
MODEL = AnalyticModel([EFFECTS["gravity"](g=G), EFFECTS["restitution"](e=E)])
SURFACES = Surfaces(0.0)
SIGMA = 3e-4
"""m, standard deviation of the heights."""


def states(*motions: tuple[float, float]) -> np.ndarray:
    """Of balls at heights above contact with vertical velocities; they drift along x."""
    made = np.zeros((len(motions), 9))
    made[:, 0], made[:, 3] = 0.02 * np.arange(len(motions)), 2.0
    made[:, 2] = np.array([height for height, _ in motions]) + MODEL.radius
    made[:, 5] = [velocity for _, velocity in motions]
    return made


def widened(made: np.ndarray, contacts: tuple[Contact, ...] = ()) -> np.ndarray:
    covariances = np.tile(SIGMA**2 * np.eye(9), (len(made), 1, 1))
    return other_sides(0.01 * np.arange(len(made)), made, covariances, contacts, MODEL, SURFACES)


@pytest.mark.parametrize("height", [0.0, 1e-4, 4e-4, 9e-4])
def test_a_last_sample_just_above_the_table_may_have_bounced(height: float) -> None:
    """The further above, the surer is the side; the jump is that of the vertical velocity alone."""
    lacking = widened(states((0.0305, -2.9), (height, -3.0)))
    p = norm.cdf(height / SIGMA)
    expected = np.zeros((9, 9))
    expected[5, 5] = p * (1.0 - p) * ((1.0 + E) * 3.0) ** 2
    np.testing.assert_allclose(lacking[-1], expected, rtol=1e-9, atol=1e-12)
    assert not lacking[0].any()


@pytest.mark.parametrize(("height", "velocity"), [(1e-4, 3.0), (2e-3, -3.0)], ids=["rising", "far above"])
def test_a_last_sample_that_cannot_have_bounced_is_left_alone(height: float, velocity: float) -> None:
    assert not widened(states((0.1, velocity), (height, velocity))).any()


def test_stamps_beside_a_contact_know_the_side_by_its_time() -> None:
    """The first stamp is 0.05 ms before the contact, which is known to 0.3 mm / 3 m/s = 0.1 ms; the next is far."""
    before, early = -3.0, 5e-5
    after = -E * (before - G * early)
    rest = 0.01 - early
    made = states((-before * early, before), (after * rest - G * rest**2 / 2, after - G * rest))
    lacking = widened(made, (Contact(0, early, 0.0),))
    p = norm.cdf(early / (SIGMA / 3.0))
    jump = np.zeros(9)  # the flight after the contact, followed back to the first stamp
    jump[5] = after + G * early - before
    jump[2] = -after * early - G * early**2 / 2 + before * early
    np.testing.assert_allclose(lacking[0], p * (1.0 - p) * np.outer(jump, jump), rtol=1e-6, atol=1e-12)
    assert not lacking[1].any()
