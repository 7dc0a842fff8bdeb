"""Predicted means and covariances while it is uncertain whether a ball has bounced, against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import ballfg as bf
from ballfg.dynamics import Surfaces
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.motion.rollout import advance
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import BallState, Belief, Propagator, next_contact
from ballfg.prediction.state import World
from ballfg.state import STATE_DIM, VELOCITY, VZ, Z

STEEP = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0]
NO_SPIN = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 0.0, 0.0, 0.0]
GRAZING = [0.0, 0.0, 0.06, 6.0, 0.3, -0.3, 10.0, 100.0, 5.0]
BACKSPIN = [0.0, 0.0, 0.3, 6.0, 0.3, -1.0, 10.0, -150.0, 40.0]

# state, factor on the sigmas of the fixture `beliefs`, whether coefficients are uncertain, contact that is passed
PASSAGES = {
    "steep": (STEEP, 1.0, True, 1),
    "no spin": (NO_SPIN, 2.0, False, 1),
    "grazing": (GRAZING, 1.5, False, 1),
    "grazing, uncertain table": (GRAZING, 1.0, True, 1),
    "backspin": (BACKSPIN, 2.0, True, 1),
    "second contact": (STEEP, 1.0, True, 2),
}
NOISE = ProcessNoise(acceleration=1e-9, spin=1e-9)  # of impacts only
TABLE = Propagator(Surfaces(0.0, -0.76), NOISE)
DRAWS = 20_000
STEPS = np.arange(-6.0, 6.1, 0.5)  # sigmas of the contact's time


class NoisyImpacts(AugmentedModel):
    """A model whose impacts add drawn noise."""

    def __init__(self, model, names):
        super().__init__(model, names)
        self.rng = torch.Generator().manual_seed(3)

    def after_bounce(self, state: Tensor) -> Tensor:
        after = super().after_bounce(state).clone()
        kick = torch.randn((len(after), 6), generator=self.rng, dtype=torch.float64)
        after[:, 3:6] += NOISE.contact_velocity * kick[:, :3]
        after[:, 6:9] += NOISE.contact_spin * kick[:, 3:]
        return after


@pytest.fixture
def passage(model, uncertain, beliefs, samples):
    """passage(name): the belief, times through its contact, and states (times, draws, 9) of drawn balls there."""

    def make(name: str) -> tuple[Belief, Tensor, np.ndarray]:
        state, factor, coefficients, count = PASSAGES[name]
        belief = beliefs(uncertain if coefficients else model, state)
        belief = replace(belief, covariance=factor**2 * belief.covariance)
        contact = next_contact(TABLE, belief)
        for _ in range(count - 1):
            contact = next_contact(TABLE, belief, after=contact.time)
        times = torch.from_numpy(contact.time + STEPS * contact.time_sigma)
        noisy = NoisyImpacts(model, uncertain.names if coefficients else ())
        drawn, now, states = samples(belief, DRAWS), 0.0, []
        for time in times.tolist():
            with torch.no_grad():
                drawn = advance(noisy, drawn, torch.full((DRAWS,), time - now, dtype=torch.float64), TABLE.surfaces)
            now = time
            states.append(drawn[:, :STATE_DIM].numpy())
        return belief, times, np.stack(states)

    return make


@pytest.mark.parametrize("name", PASSAGES)
def test_monte_carlo_of_a_passage(passage, name):
    """Sigmas are compared where 20,000 draws tell them to 3 %: beyond two sigmas too few are on the other side.

    Velocities and spins fall into two clusters. A normal interval with the right sigma holds 84 to 100 % of them at one
    stamp, and a little too much on average.
    """
    belief, times, drawn = passage(name)
    predicted = TABLE.rollout(belief, times)
    errors = drawn - predicted.states[0][:, None]
    sigma = np.sqrt(np.diagonal(predicted.covariances[0], axis1=1, axis2=2))
    told = (np.abs(STEPS) <= 2.0) | (np.abs(STEPS) > 5.0)
    ratio = (sigma / drawn.std(1))[told]
    assert np.abs(ratio - 1.0).max() < 0.1, np.abs(ratio - 1.0).max(0)
    bias = (errors.mean(1) / drawn.std(1))[told]
    assert np.abs(bias).max() < 0.12
    held = np.abs(errors) < 1.645 * sigma[:, None]
    share, positions = held.mean((0, 1)), held.mean(1)[:, :3]
    assert ((share > 0.88) & (share < 0.955)).all(), share
    assert (share[:3] < 0.92).all(), share
    assert ((positions > 0.86) & (positions < 0.96)).all()  # at each stamp
    solved = np.linalg.solve(predicted.covariances[0], errors.swapaxes(1, 2))
    nees = (errors.swapaxes(1, 2) * solved).sum(1).mean(1)[np.abs(STEPS) <= 4.0]  # beyond, one ball decides
    assert nees.max() < 15.0
    assert 8.5 < nees.mean() < 10.0


@pytest.mark.parametrize("name", PASSAGES)
def test_the_mixture_errs_less_than_the_mean_rolled_out(passage, name):
    belief, times, drawn = passage(name)
    near = np.abs(STEPS) < 1.0
    mixed = TABLE.rollout(belief, times).states[0]
    alone = np.stack([TABLE.forward(belief, time[None]).mean[0, :STATE_DIM] for time in times])
    error = [np.linalg.norm((drawn - mean[:, None])[near, :, :3], axis=-1) for mean in (mixed, alone)]
    assert np.sqrt((error[0] ** 2).mean()) < np.sqrt((error[1] ** 2).mean())
    assert np.median(error[0]) < 1.01 * np.median(error[1])


def test_far_from_contacts_nothing_changes(uncertain, beliefs):
    """To the last bit; the contacts are at 0.14 and 0.52 s, known to 3 and 6 ms."""
    belief = beliefs(uncertain, STEEP)
    times = np.arange(1, 61) / 100
    walked, linear = list(TABLE.walk(belief, times[None])), []
    for dt in np.diff(times, prepend=belief.time):
        belief = TABLE.forward(belief, dt[None])
        linear.append(belief)
    same = [
        np.array_equal(a.mean, b.mean) and np.array_equal(a.covariance, b.covariance)
        for a, b in zip(walked, linear, strict=True)
    ]
    mixed = times[~np.array(same)]
    assert (np.minimum(np.abs(mixed - 0.14), np.abs(mixed - 0.52)) < 0.04).all()
    assert 4 < len(mixed) < 16


def test_many_balls_are_predicted_as_each_alone(uncertain, beliefs):
    """Some before their contact, some near it, some after, some that bounce off the floor."""
    heights = (0.05, 0.08, 0.1, 0.12, 0.25, 0.5, -0.5)
    batch = beliefs(uncertain, *([0.0, 0.0, z, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0] for z in heights))
    times = torch.arange(1, 31, dtype=torch.float64) / 100
    together = TABLE.rollout(batch, times)
    for i in range(len(heights)):
        one = slice(i, i + 1)
        belief = replace(batch, time=batch.time[one], mean=batch.mean[one], covariance=batch.covariance[one])
        alone = TABLE.rollout(belief, times)
        np.testing.assert_allclose(together.states[i], alone.states[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(together.covariances[i], alone.covariances[0], rtol=1e-6, atol=1e-9)
    for k, walked in enumerate(TABLE.walk(batch, times.expand(len(heights), -1))):
        np.testing.assert_allclose(walked.mean[:, :STATE_DIM], together.states[:, k], rtol=1e-7, atol=1e-7)


def test_a_second_contact_soon_after_the_first_is_a_mixture_too(gravity, beliefs):
    """A hop of 0.1 s: the second contact comes while the first one's unbounced balls are still followed."""
    belief = beliefs(gravity, [0.0, 0.0, 0.0205, 1.0, 0.0, -0.55, 0.0, 0.0, 0.0])
    belief = replace(belief, covariance=0.01 * belief.covariance)
    first = next_contact(TABLE, belief)
    second = next_contact(TABLE, belief, after=first.time)
    assert 0.08 < second.time - first.time < 0.12
    speeds = TABLE.rollout(belief, [second.time - 1e-9, second.time + 1e-9])
    assert np.sqrt(speeds.covariances[0, :, VZ, VZ]) == pytest.approx(0.5 * 0.95, rel=0.15)  # half of the jump


def test_a_ball_that_comes_to_rest_or_passes_the_table_is_left_alone(gravity, beliefs):
    """Neither has two sides: a ball that lands for good stays, and one beside the table meets no surface there."""
    landing = beliefs(gravity, [0.0, 0.0, 0.02001, 1.0, 0.0, -0.03, 0.0, 0.0, 0.0])
    after = TABLE.rollout(replace(landing, covariance=1e-6 * landing.covariance), [0.05, 0.1]).covariances[0]
    assert np.isfinite(after).all()
    edge = Propagator(Surfaces(0.0, -0.76, extent=(-1.0, 1.0, -0.7, 0.7)), NOISE)
    beside = beliefs(gravity, [1.2, 0.0, 0.05, 4.0, 0.0, -3.0, 0.0, 0.0, 0.0])
    at = np.array([0.009])
    walked = next(edge.walk(beside, at[None]))
    np.testing.assert_array_equal(walked.covariance, edge.forward(beside, at).covariance)


def test_a_contact_that_is_known_widens_nothing(model, beliefs):
    belief = beliefs(model, STEEP)
    belief = replace(belief, covariance=1e-12 * belief.covariance)
    times = torch.arange(1, 31, dtype=torch.float64) / 100
    covariances = Propagator(Surfaces(0.0), ProcessNoise(1e-9, 1e-9, 1e-9, 0.0, 1e-9)).rollout(belief, times)
    assert np.abs(covariances.covariances).max() < 1e-6


def test_an_estimate_that_ends_just_before_a_contact_predicts_no_wider_than_one_that_ends_earlier(gravity):
    """Its last covariance holds the ball's other side; carried on, that would be metres after 0.2 s."""
    times = np.arange(31) / 100
    end = 0.3 + 2e-4  # s, of the contact
    path = np.stack((3.0 * times, 0.1 * times, 0.02 + 3.0 * (end - times) - 9.81 / 2 * (end - times) ** 2), axis=1)
    path += np.random.default_rng(2).normal(0.0, 0.001, path.shape)
    smoother = bf.Smoother(gravity, 0.0, bf.Settings.for_measured(gravity, position_noise=(0.001,) * 3))
    close, early = smoother.estimate(bf.Track(times, path)), smoother.estimate(bf.Track(times[:-3], path[:-3]))
    assert not close.contacts
    assert close.last.sigmas[VZ] > 0.5  # the other side is 5 m/s off
    assert early.last.sigmas[VZ] < 0.1
    sigmas = [estimate.predict(0.53 - estimate.times[-1], 1.0).sigmas[0] for estimate in (close, early)]
    assert (sigmas[0] < 1.1 * sigmas[1]).all()


def test_the_path_ahead_and_its_contact(model, beliefs):
    """At the time of the contact half of the balls rise: the mean is slow, and its sigma is half of the jump."""
    belief = beliefs(model, STEEP)
    state = BallState(0.0, belief.mean[0], belief.covariance[0], world=World(model, TABLE.surfaces))
    contact = state.predict(0.4).next_contact
    at = state.predict(contact.time, contact.time)
    before = contact.state[VZ]
    assert before < -2.0
    assert abs(at.states[0, VZ]) < 0.1 * abs(before)
    assert np.sqrt(at.covariances[0, VZ, VZ]) == pytest.approx(0.95 * abs(before), rel=0.03)
    assert at.positions[0, 2] > contact.state[Z]
    assert np.abs(at.states[0, VELOCITY][:2]).max() < 5.0
