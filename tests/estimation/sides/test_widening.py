"""What covariances gain beside a contact, by hand, for a ball that only falls and bounces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import chi2, norm

from ballfg.dynamics import EFFECTS, AnalyticModel
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.sides.monitor import ENOUGH, GATE, MORE, SPREAD, Shared, widening, widening_near_contacts

G, E = 9.81, 0.9
MODEL = AnalyticModel([EFFECTS["gravity"](g=G), EFFECTS["restitution"](e=E), EFFECTS["table_height"](offset=0.0)])
SIGMA = 3e-4
"""m, standard deviation of the heights."""
BEFORE, EARLY = -3.0, 5e-5
"""m/s before the contact; s, by which the first stamp is before it."""


def beside(height_sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """States just before and 10 ms after a contact, and what their covariances gain.

    Args: height_sigma: m, of the table.
    """
    after, rest = -E * (BEFORE - G * EARLY), 0.01 - EARLY
    made = np.zeros((2, 9))
    made[:, 2] = np.array([-BEFORE * EARLY, after * rest - G * rest**2 / 2]) + MODEL.radius
    made[:, 5] = BEFORE, after - G * rest
    covariances = np.tile(SIGMA**2 * np.eye(9), (2, 1, 1))
    (name,) = [name for name, _ in MODEL.named_parameters() if name.endswith("table_height.offset")]
    shared = Shared(np.zeros(1), np.array([[height_sigma**2]]), np.zeros((2, 9, 1)))
    model = AugmentedModel(MODEL, [name])
    contacts = (Contact(0, EARLY, 0.0),)
    return made, widening_near_contacts(np.array([0.0, 0.01]), made, covariances, contacts, model, shared)


def test_the_gate_rejects_one_good_position_in_a_million() -> None:
    assert chi2.sf(GATE, 3) == pytest.approx(1e-6, rel=1e-6)


@pytest.mark.parametrize("height_sigma", [1e-9, 4e-4])
def test_stamps_beside_a_contact_know_the_side_by_the_gap(height_sigma: float) -> None:
    """The gap is as uncertain as the ball's height and the table's together; the second stamp is far."""
    made, lacking = beside(height_sigma)
    chance = norm.sf(EARLY * -BEFORE / np.hypot(SIGMA, height_sigma))
    jump = np.zeros(9)  # the flight after the contact, followed back to the first stamp
    jump[5] = made[1, 5] + G * 0.01 - BEFORE
    jump[2] = made[1, 2] - made[1, 5] * 0.01 - G * 0.01**2 / 2 - made[0, 2]
    share = max(chance, min(MORE * chance, ENOUGH))
    np.testing.assert_allclose(lacking[0], share * np.outer(jump, jump), rtol=1e-6, atol=1e-12)
    assert not lacking[1].any()


def test_a_table_of_uncertain_height_puts_more_stamps_in_doubt() -> None:
    """At a tenth of the height's sigma the first stamp is sure of its side."""
    assert beside(4e-4)[1][0, 5, 5] > 1.02 * beside(1e-9)[1][0, 5, 5]


def test_over_a_gap_with_two_contacts_the_other_side_has_the_first_one_only() -> None:
    """The ball bounces twice between two stamps, the second time just before the later one."""
    fast, hop = 3.0, 2.0 * E * 3.0 / G
    begin = 0.1  # s, of the fall before the first contact
    times = np.array([0.0, begin + hop + EARLY])
    made = np.zeros((2, 9))
    made[0, 2], made[0, 5] = (fast - G * begin) * begin + G * begin**2 / 2, -(fast - G * begin)
    made[1, 2], made[1, 5] = E * E * fast * EARLY, E * E * fast - G * EARLY
    made[:, 2] += MODEL.radius
    contacts = (Contact(0, begin, 0.0), Contact(0, begin + hop, 0.0))
    nothing = Shared(np.zeros(0), np.zeros((0, 0)), np.zeros((2, 9, 0)))
    lacking = widening_near_contacts(times, made, np.tile(SIGMA**2 * np.eye(9), (2, 1, 1)), contacts, MODEL, nothing)
    chance = norm.sf(EARLY * made[1, 5] / SIGMA)
    share = max(chance, min(MORE * chance, ENOUGH))
    jump = -E * fast - G * EARLY - made[1, 5]
    assert lacking[1, 5, 5] == pytest.approx(share * jump**2, rel=1e-6)
    assert not lacking[0].any()


def test_a_covariance_that_covers_is_never_less_than_either() -> None:
    """In no direction is it less certain of itself than the near side, nor, once in doubt, than the far side."""
    rng = np.random.default_rng(4)
    for chance in (SPREAD, 0.1, 0.5):
        near, far = (a @ a.T for a in rng.normal(size=(2, 9, 9)))
        jump = rng.normal(size=9)
        whole = near + widening(near, far, jump, chance)
        for less in (near, far, near + chance * np.outer(jump, jump)):
            assert np.linalg.eigvalsh(whole - less).min() > -1e-9
    assert np.abs(widening(near, far, jump, 1e-12)).max() < 1e-8


def test_the_jump_is_that_of_the_models_own_bounce() -> None:
    """The state that the flight after the contact leads back to is the one that a bounce makes there."""
    made, lacking = beside(1e-9)
    state = torch.from_numpy(made[0])
    state[2] = MODEL.radius
    bounce = MODEL.after_bounce(state)[5] - state[5]
    values, axes = np.linalg.eigh(lacking[0])
    share = values[-1] / (bounce**2).item()
    assert axes[5, -1] ** 2 > 0.999
    assert MORE * norm.sf(EARLY * -BEFORE / SIGMA) > ENOUGH
    assert share == pytest.approx(max(ENOUGH, norm.sf(EARLY * -BEFORE / SIGMA)), rel=1e-3)
