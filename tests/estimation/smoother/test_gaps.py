"""Bounces in gaps between samples: their number, by closed form, and what stays in doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import EFFECTS, AnalyticModel
from ballfg.estimation.flights.labels import label_samples
from ballfg.estimation.online.online import Online
from ballfg.estimation.result import Label
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.second_look.at_end import from_before_a_bounce, log_evidence
from ballfg.estimation.smoother.second_look.gaps import UNSURE, with_other_contacts
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import COEFFICIENTS
from ballfg.tracks import Track
from tests.estimation.nees import nees

G, E, NOISE, NOISY, RATE, GAP = 9.81, 0.9, 0.005, 0.02, 60.0, 0.4
MODEL = AnalyticModel([EFFECTS["gravity"](g=G), EFFECTS["restitution"](e=E), EFFECTS["table_height"](offset=0.0)])
SMOOTHER, OF_NOISY = (
    Smoother(MODEL, 0.0, Settings.for_measured(MODEL, position_noise=(noise,) * 3)) for noise in (NOISE, NOISY)
)
ALONG = (4.0, 0.3)
"""m/s, along the table."""


def heights(times: np.ndarray, height: float, rise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights m, vertical velocities m/s, and times of the bounces s, of a ball without spin and drag."""
    fall = (rise + np.sqrt(rise**2 + 2.0 * G * height)) / G
    speed, since, bounces = np.sqrt(rise**2 + 2.0 * G * height), fall, list[float]()
    z, v = height + rise * times - 0.5 * G * times**2, rise - G * times
    while since < times[-1]:
        bounces.append(since)
        speed *= E
        later = times >= since
        z[later] = speed * (times[later] - since) - 0.5 * G * (times[later] - since) ** 2
        v[later] = speed - G * (times[later] - since)
        since += 2.0 * speed / G
    return z, v, np.array(bounces)


def measured(
    times: np.ndarray, height: float, rise: float, noise: float, rng: np.random.Generator
) -> tuple[Track, np.ndarray, np.ndarray]:
    """A track, its true places and velocities (n, 6), and the times of all bounces."""
    z, v, bounces = heights(times, height, rise)
    across = [speed * times for speed in ALONG]
    truth = np.column_stack((*across, z + MODEL.radius, np.tile(ALONG, (len(times), 1)), v))
    return Track(times, truth[:, :3] + noise * rng.normal(size=(len(times), 3))), truth, bounces


def with_a_gap(seed: int) -> tuple[Track, np.ndarray, np.ndarray]:
    """A track without samples for a while, its true places and velocities (n, 6), and the times of all bounces."""
    rng = np.random.default_rng(seed)
    last = rng.uniform(0.8, 1.3)
    begin = rng.uniform(0.06, last - GAP - 0.1)
    times = np.arange(0.0, last, 1.0 / RATE)
    times = times[(times < begin) | (times > begin + GAP)]
    return measured(times, rng.uniform(0.05, 0.4), rng.uniform(-1.0, 1.5), NOISE, rng)


def with_two_gaps(seed: int) -> tuple[Track, np.ndarray, np.ndarray]:
    """Likewise, with few and noisy samples between two gaps."""
    rng = np.random.default_rng(seed)
    first, between, rest = rng.uniform((0.15, 0.1, 0.1), (0.3, 0.2, 0.3))
    gaps = rng.uniform(0.3, 0.48, 2)
    again = first + gaps[0] + between
    times = np.arange(0.0, again + gaps[1] + rest, 1.0 / RATE)
    times = times[(times < first) | ((times > first + gaps[0]) & (times < again)) | (times > again + gaps[1])]
    return measured(times, rng.uniform(0.05, 0.3), rng.uniform(-1.0, 1.0), NOISY, rng)


@pytest.mark.parametrize("seed", range(24))
def test_bounces_in_a_gap_are_counted(seed: int) -> None:
    """Several of these tracks had one too few or too many, and states dozens of standard deviations off."""
    track, truth, bounces = with_a_gap(seed)
    found = SMOOTHER.estimate(track)
    assert [contact.time for contact in found.contacts] == pytest.approx(bounces, abs=0.06)
    assert nees(found, truth, slice(0, 6)).max() < 40.0


@pytest.mark.parametrize("seed", range(6))
def test_a_stroke_in_a_gap_is_a_hit(seed: int) -> None:
    """No number of bounces explains a ball that comes back."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 1.2, 1.0 / 120.0)
    struck = rng.uniform(0.55, 0.65)
    after = times >= struck
    z, v, _ = heights(times, 0.3, 0.5)
    at, _, _ = heights(np.array([0.0, struck]), 0.3, 0.5)
    rise = rng.uniform(1.0, 2.0)
    z[after] = at[1] + rise * (times[after] - struck) - 0.5 * G * (times[after] - struck) ** 2
    v[after] = rise - G * (times[after] - struck)
    flying = z > 0.0
    speed = np.where(after, -4.0, 4.0)
    x = np.where(after, 4.0 * struck - 4.0 * (times - struck), 4.0 * times)
    seen = flying & (np.abs(times - struck) > 0.15)
    truth = np.column_stack((x, 0.3 * times, z + MODEL.radius, speed, np.full(len(x), 0.3), v))[seen]
    found = SMOOTHER.estimate(Track(times[seen], truth[:, :3] + NOISE * rng.normal(size=(seen.sum(), 3))))
    assert found.hits.tolist() == [int(np.diff(times[seen]).argmax())]
    assert nees(found, truth, slice(0, 6)).max() < 40.0


@pytest.mark.parametrize("seed", [13, 20, 27, 37, 58])
def test_bounces_in_two_gaps_are_counted_together(seed: int) -> None:
    """With a wrong number in the other gap, neither right number alone was more probable."""
    track, truth, bounces = with_two_gaps(seed)
    found = OF_NOISY.estimate(track)
    assert [contact.time for contact in found.contacts] == pytest.approx(bounces, abs=0.1)
    assert nees(found, truth, slice(0, 6)).max() < 40.0


@pytest.mark.parametrize("seed", range(12))
def test_a_stream_does_not_guess_the_bounces_in_a_gap(seed: int) -> None:
    """States after a long gap are those of the samples after it, until these are enough; the whole track links them."""
    track, truth, bounces = with_a_gap(seed)
    gap, stream = int(np.diff(track.times).argmax()), Online(MODEL, 0.0, SMOOTHER.settings)
    for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
        told = stream.push(time, position)
        if k > gap and told is not None:
            off = told.mean[:6] - truth[k]
            assert off @ np.linalg.solve(told.joint[:6, :6], off) < 40.0
    found = Online(MODEL, 0.0, SMOOTHER.settings).estimate(track)
    assert [contact.time for contact in found.contacts] == pytest.approx(bounces, abs=0.06)


@pytest.mark.parametrize("seed", range(10))
def test_a_bounce_before_the_last_sample_is_as_uncertain_before_a_pause_as_at_the_end(seed: int) -> None:
    """Nothing links the sides of a pause of a second; its last sample seemed to be an outlier of a falling ball."""
    rng, speed = np.random.default_rng(seed), 1.5
    bounce = rng.uniform(0.27, 0.2835)
    times = np.arange(np.ceil(RATE * bounce) + 1) / RATE
    first, truth, _ = measured(times, speed * bounce - 0.5 * G * bounce**2, G * bounce - speed, NOISE, rng)
    later = 1.0 + times[-1] + np.arange(30) / RATE
    again = np.column_stack((4.0 * later, 0.3 * later, 1.0 + MODEL.radius - 0.5 * G * (later - later[0]) ** 2))
    again += NOISE * rng.normal(size=again.shape)
    track = Track(np.append(times, later), np.concatenate((first.positions, again)))
    found, alone = SMOOTHER.estimate(track), SMOOTHER.estimate(first)
    k = len(first) - 1
    off = found.states[k, :6] - truth[k]
    assert off @ np.linalg.solve(found.covariances[k, :6, :6], off) < 30.0
    np.testing.assert_allclose(found.states[k, :6], alone.states[k, :6], atol=0.05)


def test_a_gap_is_no_hand() -> None:
    """Each side of a gap with two bounces in it is a flight."""
    track, _, bounces = with_a_gap(22)
    assert (np.diff(np.searchsorted(track.times, bounces)) == 0).any()
    assert (label_samples(track, physics_of(MODEL), (MODEL.radius,)).values == Label.FLIGHT).all()


def test_low_samples_on_both_sides_of_a_gap_are_no_low_hops() -> None:
    """Two samples beside a bounce before the gap, two beside one after it, and half a metre between them unseen."""
    fall = np.sqrt(2.0 * 0.3 / G)
    times = fall + np.concatenate((np.arange(-12, 1), 45 + np.arange(12))) / 100.0
    low, _, bounces = heights(times, 0.3, 0.0)
    assert (np.abs(times - bounces[0]) < 0.011).sum() == 2
    assert (low < 0.05).sum() >= 4
    positions = np.column_stack((*(speed * times for speed in ALONG), low + MODEL.radius))
    track = Track(times, positions + 0.003 * np.random.default_rng(3).normal(size=positions.shape))
    assert SMOOTHER.low_hops(track, SMOOTHER.segment(track)) == ()


def test_what_is_nearly_as_probable_is_in_the_covariance() -> None:
    """The second moment of a mixture about its likelier part, or more."""
    track, _, _ = with_a_gap(1)
    problem, solution = SMOOTHER.solved(track)
    one = SMOOTHER.result(problem, solution)
    moved = replace(one, states=one.states + 0.3)
    held = with_other_contacts(one, moved, np.log(0.8 / 0.2))
    jump = (moved.states - one.states)[:, :, None]
    mixture = one.covariances + 0.2 * jump * jump.swapaxes(1, 2)
    assert np.linalg.eigvalsh(held.covariances - mixture).min() > -1e-9 * np.abs(mixture).max()
    assert with_other_contacts(held, moved, 2.0).notes == (*one.notes, UNSURE)
    assert with_other_contacts(one, moved, 12.0) is one


def test_doubts_about_a_gap_outlast_another_beginning() -> None:
    """A ball that rises from the table at first was probably about to bounce, by 1.1 nats; the gap stays in doubt."""
    rng = np.random.default_rng(265)
    fall, speed = rng.uniform((0.0005, 1.5), (0.006, 3.5))
    height = speed * fall + 0.5 * G * fall**2
    last, begin, gap = rng.uniform((0.7, 0.08, 0.3), (1.0, 0.2, 0.45))
    times = np.arange(0.0, last, 1.0 / RATE)
    track, _, _ = measured(times[(times < begin) | (times > begin + gap)], height, -speed, NOISY, rng)
    problem, solution = OF_NOISY.solved(track)
    (other,), rival = solution.others, from_before_a_bounce(OF_NOISY, problem, solution)
    assert rival is not None
    odds = log_evidence(rival[1]) - log_evidence(solution)
    assert odds > 0.0
    sure, held = (OF_NOISY.result(problem, one) for one in (replace(solution, others=()), solution))
    jump = (other.solution.minimum.values.states - sure.states)[:, :, None]
    mixture = sure.covariances + jump * jump.swapaxes(1, 2) / (1.0 + np.exp(other.odds + odds))
    assert np.linalg.eigvalsh(held.covariances - mixture).min() > -1e-9 * np.abs(mixture).max()


def test_the_evidence_is_that_of_a_dense_gaussian() -> None:
    """Of the same factors, at the same point: minus half the log determinant of the whole information."""
    track, _, _ = with_a_gap(2)
    _, solution = SMOOTHER.solved(track)
    values = solution.minimum.values
    width = 9 * len(values.states)
    information = np.zeros((width + len(values.coefficients),) * 2)
    for batch in solution.graph.batches:
        rows = batch.linearize(values)
        weights = rows.loss.weight(np.linalg.norm(rows.residual, axis=1))
        for number, weight in enumerate(weights):
            own = np.zeros((rows.residual.shape[1], len(information)))
            for variable, block in zip(rows.variables[number], rows.jacobians, strict=True):
                first = width if variable == COEFFICIENTS else 9 * variable
                own[:, first : first + block.shape[2]] += block[number]
            information += weight * own.T @ own
    spread = sum(batch.log_spread() for batch in solution.graph.batches if len(batch))
    wanted = -solution.minimum.error - 0.5 * np.linalg.slogdet(information)[1] - spread
    assert log_evidence(solution) == pytest.approx(wanted, abs=1e-6)
