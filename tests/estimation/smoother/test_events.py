"""Contacts are found and refined, wherever in its interval the ball bounces and on whatever surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces
from ballfg.dynamics.motion.contact import contact_time
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import Motion, kicks_of
from ballfg.estimation.smoother.settle import initial_states, move_contacts
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.smoother.one_bounce import flown
from tests.estimation.smoother.serve import (
    EXACT,
    LATER,
    MODEL,
    SERVE,
    TABLE,
    TIMES,
    UNCERTAIN,
    bounces,
    estimate_of,
    honest,
    intervals,
    measured,
    truth,
    truth_at,
)


@pytest.mark.parametrize("phase", [0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98])
def test_contact_time(phase, settings) -> None:
    """Wherever in its interval the bounce happens: its time within 3 sigma, the states honest."""
    with torch.no_grad():
        first = float(contact_time(MODEL, torch.tensor([SERVE], dtype=torch.float64), 0.0)[0])
    times = TIMES + first - 0.01 * (np.floor(first / 0.01) + phase)
    times = times[times >= 0.0]
    states = truth(SERVE, np.concatenate(([0.0], times)))[1:]
    estimate = estimate_of(states, measured(states), settings, times)
    assert estimate.status is Status.OK
    honest(estimate, states)
    contact = estimate.contacts[0]
    sigma = estimate.sigmas[contact.interval, 2] / abs(estimate.states[contact.interval, 5])
    assert abs(contact.time - first) < 3 * sigma
    if 0.1 <= phase <= 0.9:  # further than 3 sigma from the stamps: the interval is certain
        assert contact.interval == bounces(states)[0]
        assert times[contact.interval] <= contact.time <= times[contact.interval + 1]


@pytest.mark.parametrize("shift", [-2, -1, 1, 2])
def test_a_contact_in_the_wrong_interval_moves_to_the_right_one(shift, settings) -> None:
    track = Track(LATER, measured(truth_at(LATER)), name="t")
    smoother = Smoother(MODEL, TABLE, settings)
    found = smoother.segment(track)
    right = [c.interval for c in smoother.settle(smoother.problem(track, found)).events.contacts]
    planted = tuple(
        Contact(c.interval + shift * (i == 0), c.time + 0.01 * shift, c.height) for i, c in enumerate(found.contacts)
    )
    wrong = replace(found, contacts=planted)
    solution = smoother.settle(smoother.problem(track, wrong))
    assert [c.interval for c in solution.events.contacts] == right
    assert len(solution.events.segmentation.hits) == 0


def test_values_to_go_on_from_change_sides_with_their_contact() -> None:
    """The state between the old and the new place is moved to the other side: finite, and close to the truth."""
    states = truth(SERVE)
    track = Track(TIMES, measured(states), name="t")
    bounce = bounces(states)[0]
    found = Smoother(MODEL, TABLE, EXACT).segment(track)
    start = (
        Smoother(MODEL, TABLE, EXACT)
        .problem(track, found)
        .start(initial_states(track, found.contacts, found, MODEL, None))
    )
    start.states[:] = states
    forward = move_contacts(start, TIMES, ((bounce, 0.0),), ((bounce + 1, 0.0),), MODEL)
    assert forward.states[bounce + 1, 5] < 0.0  # now before the contact
    back = move_contacts(forward, TIMES, ((bounce + 1, 0.0),), ((bounce, 0.0),), MODEL)
    np.testing.assert_allclose(back.states, states, atol=1e-9)
    gone = move_contacts(start, TIMES, ((bounce, 0.0),), (), MODEL)
    assert gone.states[bounce + 1, 5] < 0.0
    np.testing.assert_array_equal(np.delete(gone.states, bounce + 1, 0), np.delete(states, bounce + 1, 0))


def test_a_bounce_that_only_the_last_sample_saw(settings) -> None:
    times = LATER[: bounces(truth_at(LATER))[0] + 2]
    states = truth_at(times)
    estimate = estimate_of(states, measured(states), settings, times)
    assert intervals(estimate) == bounces(states) == [len(times) - 2]
    honest(estimate, states)


def test_a_bounce_that_only_the_first_sample_saw() -> None:
    """What it was before is known through the impact alone, slip and spin open: a matter for `uncertain` settings."""
    times = LATER[bounces(truth_at(LATER))[0] :]
    states = truth_at(times)
    estimate = estimate_of(states, measured(states), UNCERTAIN, times)
    assert intervals(estimate)[0] == bounces(states)[0] == 0
    assert len(estimate.contacts) == len(bounces(states))
    honest(estimate, states)


@pytest.mark.parametrize(
    ("before", "spin", "count"),
    [(0.0007, 40.0, 10), (0.002, 40.0, 10), (0.0033, 40.0, 10), (0.0047, 40.0, 10), (0.0033, 80.0, 40)],
)
def test_a_first_sample_just_before_a_bounce_is_no_outlier(before: float, spin: float, count: int) -> None:
    """Balls that fall at 3 m/s. A state of the wrong side has a covariance that holds the right one.

    The more it may spin, the narrower is the valley of velocities and times before the bounce that lead to those after.
    """
    rng, wrong, outliers = np.random.default_rng(round(1e4 * before)), 0, 0
    times = np.arange(50) / 150.0
    for _ in range(count):
        surface = float(MODEL.surface_offset(torch.zeros(1, 9, dtype=torch.float64)).detach()) + MODEL.radius
        start = np.array([0.0, 0.0, surface + 3.0 * before, 5.0, 0.0, -3.0, *rng.normal(0.0, spin, 3)])
        states = flown(start, times)
        settings = Settings.for_measured(MODEL, position_noise=(0.002,) * 3)
        track = Track(times, states[:, :3] + rng.normal(0.0, 0.002, (len(times), 3)))
        estimate = Smoother(MODEL, Surfaces(0.0), settings).estimate(track)
        assert estimate.status is Status.OK
        wrong += abs(estimate.states[0, 5] - states[0, 5]) > 5.0 * np.sqrt(estimate.covariances[0, 5, 5])
        outliers += int(estimate.quality[0] != 0)
    assert outliers == 0
    assert wrong <= (2 if before < 0.001 else 0)  # 2 mm above the surface the samples show no bounce


LYING = 0.02 - 0.003


SURFACE_CASES = {
    "rolling": ([0.0, 0.0, LYING, 1.5, 0.2, 0.0, -10.0, 75.0, 0.0], TABLE, []),
    "at rest": ([0.0, 0.0, LYING, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], TABLE, []),
    "dropped": ([0.0, 0.0, 0.3, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0], TABLE, [0.0, 0.0, 0.0]),
    "floor": ([1.5, 0.0, 0.3, 2.5, 0.1, 0.5, 0.0, 30.0, 0.0], Surfaces(0.0, -0.76, (-1.0, 1.0, -1.0, 1.0)), [-0.76]),
    "table, then floor": (
        [0.2, 0.0, 0.3, 2.5, 0.1, 0.5, 0.0, 30.0, 0.0],
        Surfaces(0.0, -0.76, (-1.0, 1.0, -1.0, 1.0)),
        [0.0, -0.76],
    ),
}


@pytest.mark.parametrize("case", SURFACE_CASES)
def test_surfaces(case, settings) -> None:
    start, surfaces, heights = SURFACE_CASES[case]
    times = 0.01 * np.arange(120)
    states = truth(start, times, surfaces)
    estimate = estimate_of(states, measured(states), settings, times, surfaces)
    assert estimate.status is Status.OK
    assert [contact.height for contact in estimate.contacts] == heights
    assert intervals(estimate) == bounces(states)
    assert len(estimate.hits) == 0
    honest(estimate, states)


def test_the_process_noise_knows_when_a_contact_was_to_a_64th_of_its_interval() -> None:
    dt, times = 0.008, (0.0013, 0.0071)
    (kicks,) = kicks_of([Motion(heights=(0.0, 0.0), times=times)], np.array([dt])).times
    np.testing.assert_allclose(kicks, times, rtol=0, atol=0.5 * dt / 64)
    np.testing.assert_allclose(kicks / dt * 64, np.round(kicks / dt * 64), atol=1e-9)
