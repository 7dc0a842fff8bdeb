"""Radar speeds and spins: factors, and all estimators against dense least squares, each other and known statistics."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from scipy.stats import chi2, norm

from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model, rollout
from ballfg.estimation import ExtendedKalmanFilter, Online, RadarSpeed, Settings, Smoother, SpinReading
from ballfg.estimation.observations.innovation import FilterInnovation
from ballfg.estimation.observations.observation import Context
from ballfg.estimation.observations.reading import FARTHEST, Reading, ReadingFactors
from ballfg.estimation.online.windows.linear import LinearFactors
from ballfg.factors.batch import COEFFICIENTS, Values
from ballfg.factors.check import check_factor
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.tracks import Track
from tests.estimation.observations.flights import (
    NOISE,
    NOWHERE,
    PLAIN,
    SPEED_SIGMA,
    PlainSpeed,
    PlainSpin,
    dense,
    flight,
    gravity_model,
    with_speeds,
    without,
)

METHODS = (Smoother, Online, ExtendedKalmanFilter)
TABLE = Surfaces.table_tennis(0.76)
DELAYS = (None, (0.004, 0.0, -0.003))


def reading(sort: type[Reading], delay: tuple[float, ...] | None) -> Reading:
    values = np.random.default_rng(1).normal(5.0, 1.0, (3, len(sort.columns)))
    return sort([0, 1, 1], values, [0.1, 0.2, 0.3], delay)


def context_of(track: Track, model: AnalyticModel | None = None) -> Context:
    return Context(track, model or nominal_model(), PLAIN, np.full((len(track), 3), 0.002))


# --- factors


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("sort", [RadarSpeed, SpinReading])
def test_jacobians_and_the_residual_in_torch(sort: type[Reading], delay: tuple[float, ...] | None) -> None:
    track, truth, _ = flight(0, 2)
    batch = reading(sort, delay).batch(context_of(track))
    check_factor(batch, Values(truth, np.zeros(0)))
    inputs = truth[batch.variables[:, 0]]
    expected, (jacobian,) = batch.compute(slice(None), (inputs,))
    states = torch.from_numpy(inputs).requires_grad_(True)
    residual = batch.residual((states,))
    np.testing.assert_allclose(residual.detach().numpy(), expected, rtol=1e-14)
    for column in range(batch.dim):
        (slope,) = torch.autograd.grad(residual[:, column].sum(), states, retain_graph=True)
        np.testing.assert_allclose(slope.numpy(), jacobian[:, column], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("predicted", "columns"),
    [
        (lambda _, state: state[..., 3:6].norm(dim=-1), ("speed",)),
        (lambda _, state: state[..., 3:4], ("vx", "vy")),
        (lambda _, state: state[..., 3:6], ("speed",)),
    ],
    ids=["without its axis", "one for both columns", "too many"],
)
def test_a_reading_predicts_one_number_a_column(method: type, predicted: object, columns: tuple[str, ...]) -> None:
    sort = type("Mine", (PlainSpeed,), {"predicted": predicted, "columns": columns})
    track, truth, _ = flight(0, 5)
    own = sort([0, 1, 2], truth[:3, 3 : 3 + len(columns)], 0.05)
    with pytest.raises(ValueError, match=rf"Mine.predicted must return \(..., {len(columns)}\), one number a column"):
        method(gravity_model(), NOWHERE, PLAIN).estimate(track.observed(own))


def test_a_ball_at_rest_has_a_speed_and_no_direction() -> None:
    batch = RadarSpeed([0], [2.0], 0.5).batch(context_of(flight(0, 1)[0]))
    residual, (jacobian,) = batch.compute(slice(None), (np.zeros((1, 9)),))
    np.testing.assert_allclose(residual, [[-4.0]], atol=1e-5)
    assert not jacobian.any()


def test_delays_carry_the_state_in_free_flight() -> None:
    """Under gravity the vertical velocity falls by g times the delay."""
    track, truth, _ = flight(0, 2)
    delay = 0.004
    batch = RadarSpeed([1], [0.0], 1.0, [delay]).batch(context_of(track, gravity_model()))
    velocity = truth[1, 3:6] - [0.0, 0.0, 9.81 * delay]
    np.testing.assert_allclose(batch.linearize(Values(truth, np.zeros(0))).residual, [[np.linalg.norm(velocity)]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0], [[1.0, 2.0]], 0.1), r"values of 'speed' must have shape \(1, 1\); got \(1, 2\)"),
        (([0], [np.nan], 0.1), "values of 'speed' must be finite"),
        (([0], [5.0], 0.0), "sigma of 'speed' must be positive and finite"),
        (([1, 0], [5.0, 5.0], 0.1), "state of 'speed' must ascend"),
        (([0.01], [5.0], 0.1), r"state of 'speed' must be indices of samples, whole numbers from 0 on; got \[0.01\]"),
        (([-1], [5.0], 0.1), "state of 'speed' must be indices of samples, whole numbers from 0 on"),
        (([0], [5.0], [0.1, 0.1]), r"sigma of 'speed' must be one number, \(1,\) or \(1, 1\); got \(2,\)"),
        (([0], [5.0], 0.1, [0.0, 0.0]), r"delay of 'speed' must have shape \(1,\); got \(2,\)"),
    ],
)
def test_readings_that_make_no_sense_are_refused(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RadarSpeed(*arguments)


def test_readings_find_their_sample() -> None:
    track = Track(np.array([1.0, 1.01, 1.02]), np.arange(9.0).reshape(3, 3))
    found = RadarSpeed.at(track, [1.021, 1.004, 0.999], [3.0, 2.0, 1.0], [0.3, 0.2, 0.1])
    np.testing.assert_array_equal(found.state, [0, 0, 2])
    np.testing.assert_allclose(found.delay, [-0.001, 0.004, 0.001], atol=1e-12)
    np.testing.assert_array_equal(found.values[:, 0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(found.sigma[:, 0], [0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match=f"must lie within {FARTHEST:g} s of a sample; the one at t=1.08 s is 0.06 s"):
        RadarSpeed.at(track, [1.08], [3.0], 0.1)


def test_readings_go_to_the_nearest_samples_of_another_track() -> None:
    old = Track(np.array([0.0, 0.1, 0.2]), np.zeros((3, 3)), name="old")
    new = Track(np.array([0.02, 0.09, 0.14, 0.21]), np.zeros((4, 3)), name="new")
    moved = SpinReading([0, 2], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], 0.5, delay=[0.01, -0.07]).onto(old, new)
    assert moved.state.tolist() == [0, 2]
    np.testing.assert_allclose(moved.delay, [-0.01, -0.01], atol=1e-12)
    np.testing.assert_array_equal(moved.values, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert (moved.sigma == 0.5).all()


def test_an_innovation_sees_the_coefficients_and_not_the_biases() -> None:
    rng = np.random.default_rng(4)
    A, B, b = rng.normal(size=(2, 9)), rng.normal(size=(2, 3)), rng.normal(size=2)
    mean, root = rng.normal(size=15), rng.normal(size=(15, 15))
    factor = LinearFactors([0, COEFFICIENTS], [np.zeros((1, 9)), np.zeros((1, 3))], [A, B], b, False)
    found = FilterInnovation.of(factor, mean, root @ root.T, biases=3)
    H = np.concatenate((A, B, np.zeros((2, 3))), axis=1)
    np.testing.assert_allclose(found.H, H)
    np.testing.assert_allclose(found.residual, H @ mean - b)
    np.testing.assert_allclose(found.spread, H @ root @ root.T @ H.T)


def test_a_part_of_a_track_keeps_the_right_readings() -> None:
    track = with_speeds(3, every=3)
    (speeds,) = track.observations
    part = track.between(float(track.times[5]), float(track.times[12]))
    (kept,) = part.observations
    inside = (speeds.state >= 5) & (speeds.state <= 12)
    np.testing.assert_array_equal(kept.state, speeds.state[inside] - 5)
    np.testing.assert_array_equal(kept.values, speeds.values[inside])
    np.testing.assert_array_equal(part.times[kept.state], track.times[speeds.state[inside]])


# --- estimates


@pytest.mark.parametrize("delay", [0.0, 0.003])
def test_the_smoother_is_dense_least_squares(delay: float) -> None:
    """1e-5 of a standard deviation: where the minimisation ends, the covariances are those at the minimum."""
    track = with_speeds(5, every=2, delay=delay)
    estimate = Smoother(gravity_model(), NOWHERE, PLAIN).estimate(track)
    states, covariances, _ = dense(track)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert np.abs((estimate.states - states) / sigma).max() < 1e-5
    np.testing.assert_allclose(estimate.sigmas, sigma, rtol=1e-5)


@pytest.mark.parametrize("delay", [0.0, 0.003])
def test_all_estimators_agree_at_the_newest_sample_and_know_the_speed_better(delay: float) -> None:
    """0.05 of a standard deviation: filter and window linearise a speed where the ball was then thought to be."""
    for seed in range(4):
        track = with_speeds(seed, every=2, delay=delay)
        found = {sort.name: sort(gravity_model(), NOWHERE, PLAIN).estimate(track) for sort in METHODS}
        smoother = found["smoother"]
        for estimate in found.values():
            assert np.abs((estimate.states[-1] - smoother.states[-1]) / smoother.sigmas[-1]).max() < 0.05
            np.testing.assert_allclose(estimate.sigmas[-1], smoother.sigmas[-1], rtol=0.01)
        for sort in METHODS:
            alone = sort(gravity_model(), NOWHERE, PLAIN).estimate(without(track))
            assert speed_sigma(found[sort.name]) < 0.5 * speed_sigma(alone)


def speed_sigma(estimate) -> float:
    direction = estimate.states[-1, 3:6] / np.linalg.norm(estimate.states[-1, 3:6])
    return float(np.sqrt(direction @ estimate.covariances[-1, 3:6, 3:6] @ direction))


def test_readings_beyond_what_they_state_are_noted() -> None:
    """Errors of three stated sigmas in turns to either side; the right ones say nothing."""
    track = with_speeds(3, samples=40)
    (speeds,) = track.observations
    assert isinstance(speeds, RadarSpeed)
    one = Smoother(gravity_model(), NOWHERE, PLAIN)
    assert one.estimate(track).notes == ()
    shifted = speeds.values + 3.0 * SPEED_SIGMA * (-1.0) ** np.arange(len(speeds))[:, None]
    (note,) = one.estimate(without(track).observed(RadarSpeed(speeds.state, shifted, SPEED_SIGMA))).notes
    assert re.match(r"the measurements 'speed' lie [\d.]+ times as far", note)


@pytest.mark.parametrize("sort", [Smoother, pytest.param(Online, marks=pytest.mark.thorough), ExtendedKalmanFilter])
def test_innovations_of_speeds_are_standard_normal(sort: type) -> None:
    """The filters' are independent of each other; of the smoother's, one of each track is taken."""
    found = []
    for seed in range(60):
        speeds = sort(gravity_model(), NOWHERE, PLAIN).estimate(with_speeds(seed, every=4)).innovations["speed"]
        assert speeds.shape == (5, 1)
        found.append(speeds[2:3] if sort is Smoother else speeds[1:])
    whitened = np.concatenate(found).ravel()
    low, high = chi2.ppf([0.005, 0.995], len(whitened))
    assert low < (whitened**2).sum() < high
    assert abs(whitened.mean()) < 2.6 / np.sqrt(len(whitened))


@pytest.mark.parametrize("sort", METHODS)
@pytest.mark.parametrize("sample", [0, 12])
def test_a_spin_reading_combines_with_the_prior(sort: type, sample: int) -> None:
    """Under gravity alone nothing else tells the spin: prior, random walk and reading make two Gaussians."""
    track, truth, _ = flight(2)
    read = truth[sample, 6:] + [4.0, -3.0, 2.0]
    sigma = np.array([5.0, 10.0, 20.0])
    seen = track.observed(PlainSpin([sample], read[None], sigma[None]))
    estimate = sort(gravity_model(), NOWHERE, PLAIN).estimate(seen)
    prior = PLAIN.spin_prior**2
    if (
        sort is not ExtendedKalmanFilter
    ):  # the graph keeps a wide prior beside, should a robust loss let go of the other
        prior = 1 / (1 / prior + 1 / 2000.0**2)
    prior += NOISE.spin**2 * (track.times[sample] - track.times[0])
    posterior = 1 / (1 / prior + 1 / sigma**2)
    np.testing.assert_allclose(estimate.states[sample, 6:], posterior * read / sigma**2, rtol=1e-6)
    np.testing.assert_allclose(estimate.sigmas[sample, 6:], np.sqrt(posterior), rtol=1e-6)
    later = posterior + NOISE.spin**2 * (track.times[-1] - track.times[sample])
    np.testing.assert_allclose(estimate.sigmas[-1, 6:], np.sqrt(later), rtol=1e-6)


def test_the_filter_leaves_out_a_speed_before_it_knows_a_velocity() -> None:
    track, truth, _ = flight(2)
    speeds = PlainSpeed([0, 5], np.linalg.norm(truth[[0, 5], 3:6], axis=1), SPEED_SIGMA)
    estimate = ExtendedKalmanFilter(gravity_model(), NOWHERE, PLAIN).estimate(track.observed(speeds))
    assert np.isnan(estimate.innovations["speed"]).tolist() == [[True], [False]]
    assert np.abs((estimate.states[-1] - truth[-1]) / estimate.sigmas[-1]).max() < 4.0


def bounced_with_a_fast_radar(seed: int) -> tuple[Track, np.ndarray]:
    """A camera of 25 Hz and a radar of 200 Hz with stamps of its own: the flight with two bounces, and its truth."""
    rng = np.random.default_rng(seed)
    spread = [0.0, 0.0, 0.0, 0.4, 0.2, 0.3, 20.0, 0.0, 0.0]
    start = np.array([-1.2, 0.0, 1.0, 4.0, 0.0, -0.2, 0.0, 80.0, 10.0]) + spread * rng.standard_normal(9)
    stamps = np.arange(14) / 25
    readings = np.arange(0.0017, stamps[-1], 0.005)
    times = np.sort(np.append(stamps[1:], readings))
    path = rollout(nominal_model(), torch.from_numpy(start)[None], torch.from_numpy(times), TABLE)[0].detach().numpy()
    truth = np.vstack((start, path[np.isin(times, stamps)]))
    track = Track(stamps, truth[:, :3] + rng.normal(0.0, 0.003, (len(stamps), 3)))
    speeds = np.linalg.norm(path[np.isin(times, readings), 3:6], axis=1) + rng.normal(0.0, 0.02, len(readings))
    return track.observed(RadarSpeed.at(track, readings, speeds, 0.02)), truth


@pytest.mark.parametrize(
    "sort", [Smoother, *(pytest.param(sort, marks=pytest.mark.thorough) for sort in (Online, ExtendedKalmanFilter))]
)
def test_speeds_between_stamps_leave_covariances_honest(sort: type) -> None:
    """From the first sample on, where a filter knows no velocity, and beside bounces that lie between the stamps."""
    settings = Settings.for_measured(nominal_model(), position_noise=(0.003,) * 3)
    squares = []
    for seed in range(24):
        track, truth = bounced_with_a_fast_radar(seed)
        estimate = sort(nominal_model(), TABLE, settings).estimate(track)
        off = (estimate.states - truth)[:, 3:6, None]
        squares.append((off.swapaxes(1, 2) @ np.linalg.solve(estimate.covariances[:, 3:6, 3:6], off)).ravel())
    assert np.mean(squares) < 3.0  # chi-square with 3 degrees of freedom, of a model that allows for more than there is
    assert np.max(squares) < chi2.isf(1e-4 / np.size(squares), 3)


@pytest.mark.parametrize("loss", [RadarSpeed.loss, Loss()], ids=["huber", "squared"])
def test_a_reading_beside_a_bounce_is_compared_with_the_state_on_its_own_side(
    loss: Loss, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bounce halves the speed's vertical part: readings of the wrong side lie 25 to 48 sigma off."""
    monkeypatch.setattr(RadarSpeed, "loss", loss)
    smoother = Smoother(nominal_model(), TABLE, Settings.for_measured(nominal_model(), position_noise=(0.003,) * 3))
    found, squares = [], []
    for seed in range(24):
        track, truth = bounced_with_a_fast_radar(seed)
        estimate = smoother.estimate(track)
        innovations = estimate.innovations["speed"].ravel()
        left_out, (speeds,) = np.isnan(innovations), track.observations
        assert isinstance(speeds, RadarSpeed)
        stamps = (track.times[speeds.state] + speeds.delay)[left_out]
        bounces = np.array([contact.time for contact in estimate.contacts])
        assert left_out.sum() <= 2 * len(bounces)  # 5 ms apart, and a bounce is known to 1 ms and better
        assert not len(stamps) or np.abs(stamps[:, None] - bounces).min(axis=1).max() < 0.006
        wanted = [f"{left_out.sum()} of {len(speeds)} measurements 'speed' are not used"] * bool(left_out.any())
        assert [note.split(":")[0] for note in estimate.notes] == wanted
        found.append(innovations[~left_out])
        off = (estimate.states - truth)[:, 3:6, None]
        squares.append((off.swapaxes(1, 2) @ np.linalg.solve(estimate.covariances[:, 3:6, 3:6], off)).ravel())
    whitened = np.concatenate(found)
    assert np.abs(whitened).max() < norm.isf(1e-4 / len(whitened))
    assert 0.9 < np.sqrt(np.mean(whitened**2)) < 1.1
    assert np.mean(squares) < 3.0


def test_a_track_cut_beside_a_bounce_has_no_readings_from_beyond_it() -> None:
    """The last sample before a bounce, and the first one after it, have readings from the other side of it."""
    smoother = Smoother(nominal_model(), TABLE, Settings.for_measured(nominal_model(), position_noise=(0.003,) * 3))
    squares = []
    for seed in range(8):
        track, truth = bounced_with_a_fast_radar(seed)
        k = next(contact.interval for contact in smoother.estimate(track).contacts)
        for first, last in ((0, k), (k + 1, len(track) - 1)):
            part = track.between(float(track.times[first]), float(track.times[last]))
            (speeds,) = part.observations
            assert isinstance(speeds, RadarSpeed)
            stamps, (begin, end) = part.times[speeds.state] + speeds.delay, part.times[[0, -1]]
            assert begin <= stamps.min() < begin + 0.005
            assert end - 0.005 < stamps.max() <= end
            if len(part) < 4:
                continue
            estimate = smoother.estimate(part)
            assert np.nanmax(np.abs(estimate.innovations["speed"])) < 5.0
            beside = -1 if first == 0 else 0
            off = (estimate.states - truth[first : last + 1])[beside, 3:6]
            squares.append(off @ np.linalg.solve(estimate.covariances[beside, 3:6, 3:6], off))
    assert np.sum(squares) < chi2.isf(0.01, 3 * len(squares))


def test_readings_beside_a_contact_go_to_the_sample_on_their_side() -> None:
    """A contact between 32 and 38 ms after the first of three samples; the third interval is too long to cross."""
    track = Track(np.array([0.0, 0.04, 0.08, 0.2]), np.zeros((4, 3)))
    stamps = np.array([0.005, 0.03, 0.035, 0.039, 0.04, 0.06, 0.1, 0.12, 0.17])
    readings = RadarSpeed.at(track, stamps, np.arange(9.0), 0.1)
    batch = readings.batch(context_of(track))
    assert isinstance(batch, ReadingFactors)
    assert readings.beside_contacts(batch, track, {}) is batch
    found = readings.beside_contacts(batch, track, {0: (0.032, 0.038), 2: (0.09, 0.095)})
    assert isinstance(found, ReadingFactors)
    assert found.variables[:, 0].tolist() == [0, 0, 0, 1, 1, 1, 3, 3, 3]
    kept = np.array([0, 1, 3, 4, 5, 8])
    assert readings.left_out(found) == 3
    assert np.isfinite(found.sigma[:, 0]).nonzero()[0].tolist() == kept.tolist()
    np.testing.assert_allclose(found.delay[kept], [0.005, 0.03, -0.001, 0.0, 0.02, -0.03], atol=1e-12)
    np.testing.assert_array_equal(found.values, readings.values)
    unknown = readings.beside_contacts(batch, track, {0: (0.0, 0.04)})
    assert isinstance(unknown, ReadingFactors)
    assert np.isfinite(unknown.sigma[:, 0]).tolist() == [False] * 4 + [True] * 5  # a sample's own reading stays
    rows = unknown.linearize(Values(np.ones((4, 9)), np.zeros(0)))
    assert not rows.residual[:4].any()
    assert not rows.jacobians[0][:4].any()


def test_a_filter_counts_the_curvature_of_a_measurement() -> None:
    """The speed of a ball whose velocity is hardly known has the mean and the spread of many possible balls."""
    truth = flight(0, 2)[1]
    sigma = np.repeat([0.002, 1.0, 30.0], 3)
    speeds = PlainSpeed([0], np.array([6.0]), 0.02).batch(context_of(flight(0, 2)[0]))
    found = FilterInnovation.of(speeds, truth[0], np.diag(sigma**2))
    drawn = truth[0, 3:6] + np.random.default_rng(0).standard_normal((100000, 3))
    many = np.linalg.norm(drawn, axis=1)
    np.testing.assert_allclose(6.0 + 0.02 * found.residual, many.mean(), rtol=0.01)
    np.testing.assert_allclose(0.02 * np.sqrt(found.spread + found.R)[0], many.std(), rtol=0.05)


def test_pushed_readings_are_those_of_the_track() -> None:
    track = with_speeds(7, every=3)
    (speeds,) = track.observations
    online = Online(gravity_model(), NOWHERE, PLAIN)
    for k, (time, position) in enumerate(zip(track.times, track.positions, strict=True)):
        rows = np.flatnonzero(speeds.state == k)
        beside = [PlainSpeed(0, speeds.values[row], SPEED_SIGMA) for row in rows]
        state = online.push(float(time), position, observations=beside)
    estimate = Smoother(gravity_model(), NOWHERE, PLAIN).estimate(track)
    assert np.abs((state.state - estimate.states[-1]) / estimate.sigmas[-1]).max() < 0.05
    np.testing.assert_allclose(state.sigmas, estimate.sigmas[-1], rtol=0.01)


# --- another frame


def turn(angle: float) -> torch.Tensor:
    cos, sin = np.cos(angle), np.sin(angle)
    return torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_turned_tracks_have_turned_estimates() -> None:
    """The same ball with drag and Magnus force, speeds and a spin, seen from elsewhere."""
    rotation, shift = turn(0.7), torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64)
    track, truth, _ = flight(4)
    low = Surfaces(0.2)
    track = Track(track.times, track.positions - [0.0, 0.0, 0.75], name="low").observed(
        PlainSpeed([3, 9], np.linalg.norm(truth[[3, 9], 3:6], axis=1), SPEED_SIGMA, [0.002, 0.0]),
        PlainSpin([6], truth[6:7, 6:], 15.0),
    )
    matrix = rotation.numpy()
    turned = Track(track.times, track.positions @ matrix.T + shift.numpy(), name="turned")
    turned = turned.observed(*(one.turned(rotation, shift) for one in track.observations))
    tight = LevenbergMarquardt(tolerance=1e-11, max_iterations=100)
    one, other = (Smoother(nominal_model(), low, PLAIN, tight).estimate(t) for t in (track, turned))
    expected = np.hstack((one.states[:, :3] @ matrix.T + shift.numpy(), one.states[:, 3:6] @ matrix.T))
    assert np.abs((other.states[:, :6] - expected) / one.sigmas[:, :6]).max() < 1e-5
    assert np.abs((other.states[:, 6:] - one.states[:, 6:] @ matrix.T) / one.sigmas[:, 6:]).max() < 1e-5


def test_what_cannot_be_turned_says_so() -> None:
    with pytest.raises(ValueError, match="sigma of 'spin' must be the same along x and y"):
        SpinReading([0], [[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0]]).turned(turn(1.0), torch.zeros(3))

    class Altitude(Reading):
        name, file, columns = "altitude", None, ("z",)

        def predicted(self, state: torch.Tensor) -> torch.Tensor:
            return state[..., 2:3]

    with pytest.raises(ValueError, match=r"the observation 'altitude' cannot be turned.*write Altitude.turned"):
        Altitude([0], [1.0], 0.1).turned(turn(1.0), torch.zeros(3))


def test_one_reading_may_be_a_plain_number() -> None:
    plain, listed = RadarSpeed(0, 6.2, 0.1), RadarSpeed([0], [6.2], 0.1)
    np.testing.assert_array_equal(plain.values, listed.values)
    with pytest.raises(ValueError, match="must have shape"):
        RadarSpeed([0, 1], 6.2, 0.1)
