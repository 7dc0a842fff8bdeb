"""Contacts are found and refined, missed hits are marked, bad samples do no harm, short tracks are honest.

Truth is a rollout of the model the smoother uses, without process noise; positions have 1.5 mm of noise. "Honest" is: a
status that says how it went, finite numbers, and the truth within 4 standard deviations in every component.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, contact_time, nominal_model, rollout
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import Motion
from ballfg.estimation.smoother.settle import initial_states, move_contacts
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track

SIGMA = 0.0015
MODEL = nominal_model()
TABLE = Surfaces.table_tennis(0.0)
SERVE = [0.0, 0.0, 0.3, 4.0, 0.3, 1.0, 10.0, 60.0, 20.0]
TIMES = 0.01 * np.arange(80)
EXACT = Settings(position_noise=(SIGMA,) * 3)
UNCERTAIN = Settings.for_measured(MODEL, position_noise=(SIGMA,) * 3)


@pytest.fixture(params=[EXACT, UNCERTAIN], ids=["exact", "uncertain"])
def settings(request) -> Settings:
    return request.param


def truth(start: list[float], times: np.ndarray = TIMES, surfaces: Surfaces = TABLE) -> np.ndarray:
    """(n, 9) states of the undisturbed ball."""
    with torch.no_grad():
        state = torch.tensor([start], dtype=torch.float64)
        return rollout(MODEL, state, torch.from_numpy(times - times[0]), surfaces)[0].numpy()


LATER = TIMES + 0.005
"""s, stamps between which the serve bounces half way: at 0.3498 s."""


def truth_at(times: np.ndarray) -> np.ndarray:
    """The serve at times of its own clock."""
    return truth(SERVE, np.concatenate(([0.0], times)))[1:]


def measured(states: np.ndarray, seed: int = 1) -> np.ndarray:
    return states[:, :3] + SIGMA * np.random.default_rng(seed).standard_normal((len(states), 3))


def bounces(states: np.ndarray) -> list[int]:
    """Intervals in which the ball turned upwards."""
    return np.flatnonzero(np.diff(states[:, 5]) > 0.5).tolist()


def intervals(estimate: Estimate) -> list[int]:
    return [contact.interval for contact in estimate.contacts]


def honest(estimate: Estimate, states: np.ndarray, *, sigmas: float = 4.0) -> None:
    assert np.isfinite(estimate.states).all()
    sigma = estimate.sigmas
    assert np.isfinite(sigma).all()
    assert (sigma > 0).all()
    correlation = estimate.covariances / (sigma[:, :, None] * sigma[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 0
    assert np.abs((estimate.states - states) / sigma).max() < sigmas


def estimate_of(states: np.ndarray, positions: np.ndarray, settings: Settings, times=TIMES, surfaces=TABLE) -> Estimate:
    return Smoother(MODEL, surfaces, settings).estimate(Track(times, positions, name="t"))


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


KICKS = {"racket": (-8.0, 1.0, 0.5), "touch": (0.7, -0.4, 0.5)}


def hit_serve(kick: tuple[float, float, float]) -> np.ndarray:
    """The serve, hit at sample 20."""
    before = truth(SERVE, TIMES[:21])
    start = before[-1].copy()
    start[3:6] += kick
    return np.concatenate((before, truth(start.tolist(), TIMES[20:])[1:]))


@pytest.mark.parametrize("kick", KICKS)
def test_a_hit_is_found(kick, settings) -> None:
    states = hit_serve(KICKS[kick])
    estimate = estimate_of(states, measured(states), settings)
    assert estimate.status is Status.OK
    assert estimate.hits.tolist() == [20]
    assert len(estimate.contacts) == len(bounces(states))
    states[20, 3:9] = estimate.states[20, 3:9]  # at the very stamp of the hit it may be before or after
    honest(estimate, states)


def test_a_hit_that_the_segmentation_missed_is_marked(settings) -> None:
    """Its dynamics factor is broken by far more than chance; solve() marks it and estimates again.

    A touch of 1 m/s would not break it: process noise of several intervals makes room for that.
    """
    states = hit_serve(KICKS["racket"])
    track = Track(TIMES, measured(states), name="t")
    smoother = Smoother(MODEL, TABLE, settings)
    blind = replace(smoother.segment(track), hits=np.zeros(0, dtype=np.int64))
    solution = smoother.settle(smoother.problem(track, blind))
    hits = solution.events.segmentation.hits
    assert len(hits) == 1
    assert 19 <= hits[0] <= 21
    unhurt = np.r_[0:18, 24:80]
    off = np.abs(solution.minimum.values.states - states)[unhurt] / smoother.estimate(track).sigmas[unhurt]
    assert off[:, :6].max() < 4.5


def test_a_known_hit_that_is_harder_than_stated_does_not_hide_another() -> None:
    """The first breaks its own factor more than the second does, which alone is still to be found."""
    nowhere = Surfaces(-20.0)
    first = truth(SERVE, TIMES[:21], nowhere)
    second = truth([*first[-1, :3], -8.0, 1.0, 3.0, *first[-1, 6:]], TIMES[20:51], nowhere)
    third = truth([*second[-1, :3], -4.0, -1.0, 3.0, *second[-1, 6:]], TIMES[50:], nowhere)
    states = np.concatenate((first, second[1:], third[1:]))
    weak = replace(EXACT, process=replace(EXACT.process, hit_velocity=0.3))
    track = Track(TIMES, measured(states), name="t")
    smoother = Smoother(MODEL, nowhere, weak)
    one = replace(smoother.segment(track), hits=np.array([20]))
    hits = smoother.settle(smoother.problem(track, one)).events.segmentation.hits
    assert hits[0] == 20
    assert len(hits) == 2
    assert 49 <= hits[1] <= 51


@pytest.mark.parametrize(
    "bad",
    [[0], [1], [2], [-1], [40], [10, 40, 41, 60], [0, 25, 50, 75]],
    ids=["first", "second", "third", "last", "one", "four", "every-25th"],
)
@pytest.mark.parametrize("size", [0.05, 0.1])
def test_outliers_are_set_aside(bad, size, settings) -> None:
    states = truth(SERVE)
    rng = np.random.default_rng(5)
    direction = rng.standard_normal((len(bad), 3))
    positions = measured(states)
    positions[bad] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    estimate = estimate_of(states, positions, settings)
    assert estimate.status is Status.OK
    assert set(np.arange(80)[bad]) <= set(np.flatnonzero(estimate.quality).tolist())
    assert len(estimate.hits) == 0
    honest(estimate, states)


def test_a_shifted_run_is_set_aside(settings) -> None:
    """The tracker follows something 5 cm away for eight frames."""
    states = truth(SERVE)
    positions = measured(states)
    positions[55:63] += (0.03, -0.02, 0.04)
    estimate = estimate_of(states, positions, settings)
    assert estimate.status is Status.OK
    assert set(range(55, 63)) <= set(np.flatnonzero(estimate.quality).tolist())
    honest(estimate, states)


def test_a_shifted_run_across_a_bounce_is_set_aside(settings) -> None:
    states = truth_at(LATER)
    positions, bounce = measured(states), bounces(states)[0]
    run = slice(bounce - 3, bounce + 5)
    positions[run] += (0.03, -0.02, 0.04)
    estimate = estimate_of(states, positions, settings, LATER)
    assert estimate.status is Status.OK
    assert intervals(estimate) == bounces(states)
    assert len(estimate.hits) == 0
    assert set(range(80)[run]) <= set(np.flatnonzero(estimate.quality).tolist())
    honest(estimate, states)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_observations(count, settings) -> None:
    states = truth(SERVE)[:count]
    estimate = estimate_of(states, measured(states), settings, TIMES[:count])
    assert estimate.status is Status.OK
    honest(estimate, states)
    assert 1e-3 < estimate.sigmas[0, 3] < 0.3
    assert (estimate.sigmas[:, 6:] > 50.0).all()  # nothing is known of the spin but its prior


def test_one_observation(settings) -> None:
    """Position as measured, velocity and spin as their priors; the status says what to do."""
    states = truth(SERVE)[:1]
    positions = measured(states)
    estimate = estimate_of(states, positions, settings, TIMES[:1])
    assert estimate.status is Status.NO_VELOCITY
    assert "at least three samples" in estimate.status.value
    honest(estimate, states)
    np.testing.assert_allclose(estimate.states[0, :3], positions[0], atol=1e-6)
    np.testing.assert_allclose(estimate.sigmas[0, 3:6], 20.0, rtol=1e-6)


def test_samples_that_nothing_links(settings) -> None:
    """Stamps in another unit: every gap is too long to follow a ball over it."""
    states = truth(SERVE)[:10]
    estimate = estimate_of(states, measured(states), settings, np.arange(10) * 0.6)
    assert estimate.status is Status.NO_VELOCITY
    assert "check the unit of the stamps" in estimate.status.value
    np.testing.assert_allclose(estimate.sigmas[:, 3:6], 20.0, rtol=1e-6)
    linked = estimate_of(states, measured(states), settings, np.r_[np.arange(9) * 0.6, 4.81])
    assert linked.status is Status.OK


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("labelled", [True, False], ids=["label", "no-label"])
def test_five_observations_around_a_bounce(seed, labelled) -> None:
    """With a label the model may be exact; without, whether the ball slides or grips is open, which no Gaussian says:
    the tangential noise of `uncertain` stands for it."""
    states = truth(SERVE)
    part = slice(bounces(states)[0] - 2, bounces(states)[0] + 3)
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), states[part][0, 6:].tolist(), strict=True)) if labelled else {}
    settings = replace(EXACT, spin_label_noise=5.0) if labelled else UNCERTAIN
    track = Track(TIMES[part], measured(states, seed)[part], labels=labels, name="t")
    honest(Smoother(MODEL, TABLE, settings).estimate(track), states[part])


@pytest.mark.parametrize("far", [0.0, 30.0])
def test_two_samples_a_nanosecond_apart_are_one_of_half_the_variance(far, settings) -> None:
    """Rounding must not pass for motion there. `far`: m, from the origin."""
    times, states = TIMES[:70], truth(SERVE)[:70]
    states[:, 0] += far
    positions, sigmas = measured(states), np.full((70, 3), SIGMA)
    twice, again = np.insert(times, 31, times[30] + 1e-9), positions[30] + (0.001, -0.002, 0.001)
    labels, smoother = (
        dict(zip(("spin_x", "spin_y", "spin_z"), SERVE[6:], strict=True)),
        Smoother(MODEL, TABLE, settings),
    )
    found = smoother.estimate(Track(twice, np.insert(positions, 31, again, axis=0), labels=labels))
    positions[30], sigmas[30] = 0.5 * (positions[30] + again), SIGMA / np.sqrt(2.0)
    merged = smoother.estimate(Track(times, positions, sigmas, labels=labels))
    assert found.status is merged.status is Status.OK
    assert np.abs((np.delete(found.states, 31, axis=0) - merged.states) / merged.sigmas).max() < 0.05
    np.testing.assert_allclose(np.delete(found.sigmas, 31, axis=0), merged.sigmas, rtol=0.01)


@pytest.mark.parametrize("before", [1, 8, 15])
def test_a_gap_of_a_fifth_of_a_second_across_a_bounce(before, settings) -> None:
    states = truth(SERVE)
    bounce = bounces(states)[0]
    kept = np.r_[0 : bounce - before, bounce - before + 20 : 80]
    estimate = estimate_of(states[kept], measured(states)[kept], settings, TIMES[kept])
    assert estimate.status is Status.OK
    assert len(estimate.contacts) == len(bounces(states))
    honest(estimate, states[kept])


def test_only_the_rising_part(settings) -> None:
    states = truth(SERVE)
    rising = slice(0, int(np.argmax(states[:, 5] < 0)))
    estimate = estimate_of(states[rising], measured(states)[rising], settings, TIMES[rising])
    assert estimate.status is Status.OK
    assert len(estimate.contacts) == 0
    honest(estimate, states[rising])


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


def test_nothing_but_noise_is_survived(settings) -> None:
    """Positions a metre apart: whatever it says, it says it in finite numbers."""
    positions = np.random.default_rng(2).standard_normal((30, 3))
    estimate = estimate_of(np.zeros((30, 9)), positions, settings, TIMES[:30])
    assert np.isfinite(estimate.states).all()
    assert np.isfinite(estimate.covariances).all()
    assert estimate.status in (Status.OK, Status.NOT_CONVERGED)


def test_an_impossible_contact_is_a_status_not_an_exception(settings) -> None:
    """The ball is 5 m below the surface that it is said to bounce on: FAILED, measured positions, prior covariances."""
    states = truth(SERVE)[:20]
    track = Track(TIMES[:20], measured(states), name="t")
    smoother = Smoother(MODEL, TABLE, settings)
    found = replace(smoother.segment(track), contacts=(Contact(8, 0.085, -60.0),))
    problem = smoother.problem(track, found)
    estimate = smoother.result(problem, smoother.settle(problem))
    assert estimate.status is Status.FAILED
    assert "table height" in estimate.status.value
    assert np.isfinite(estimate.covariances).all()
    assert np.isnan(estimate.whitened).all()
    np.testing.assert_allclose(estimate.states[:, :2], track.positions[:, :2], atol=1e-9)


def test_sigmas_of_a_track_stay_as_they_are() -> None:
    """Outliers widen the smoother's own copy; estimating twice gives the same answer."""
    states = truth(SERVE)
    positions = measured(states)
    positions[30] += 0.2
    track = Track(TIMES, positions, sigmas=np.full((80, 3), SIGMA), name="t")
    smoother = Smoother(MODEL, TABLE, EXACT)
    first = smoother.estimate(track)
    assert track.sigmas is not None
    np.testing.assert_array_equal(track.sigmas, SIGMA)
    np.testing.assert_array_equal(smoother.estimate(track).states, first.states)
    without = smoother.estimate(Track(TIMES, positions, name="t"))
    np.testing.assert_allclose(without.states, first.states, atol=1e-12)


def test_the_process_noise_knows_when_a_contact_was_to_a_64th_of_its_interval() -> None:
    dt, times = 0.008, (0.0013, 0.0071)
    kicks = Motion(heights=(0.0, 0.0), times=times).kick_times(dt)
    np.testing.assert_allclose(kicks, times, rtol=0, atol=0.5 * dt / 64)
    np.testing.assert_allclose(np.array(kicks) / dt * 64, np.round(np.array(kicks) / dt * 64), atol=1e-9)
