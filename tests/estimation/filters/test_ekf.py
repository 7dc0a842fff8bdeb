"""The extended Kalman filter and its RTS pass: against textbook and batch solutions, and by consistency statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from ballfg.dynamics import nominal_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.effects.flight import Gravity
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.dynamics.motion.rollout import advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.tracks import Track, read_dataset
from tests.estimation.filters.filtering import (
    LOW,
    PLAIN,
    SERVE,
    SPIN_SIGMA,
    TABLE,
    run,
    simulate,
    tensor,
    with_positions,
)
from tests.estimation.nees import inside, nees
from tests.places import DATA

# --- a linear problem: gravity alone, no surface -----------------------------------------------------------------


@pytest.fixture
def linear(rng):
    times = np.cumsum(rng.uniform(0.004, 0.03, 25))
    truth, track = simulate(AnalyticModel([Gravity()]), PLAIN, SERVE, times, rng, LOW)
    return truth, track


def transition(dt: float) -> tuple[np.ndarray, np.ndarray]:
    F = np.eye(9)
    F[POSITION, VELOCITY] = dt * np.eye(3)
    drift = np.zeros(9)
    drift[[2, 5]] = -9.81 * dt**2 / 2, -9.81 * dt
    return F, drift


def start_of(track: Track) -> tuple[np.ndarray, np.ndarray]:
    x = np.concatenate((track.positions[0], np.zeros(3), track.spin_label))
    return x, np.diag([0.002**2] * 3 + [20.0**2] * 3 + [SPIN_SIGMA**2] * 3)


def test_linear_problem_is_the_textbook_kalman_filter(linear):
    _, track = linear
    result = ExtendedKalmanFilter(AnalyticModel([Gravity()]), LOW, PLAIN).estimate(track)
    x, P = start_of(track)
    H, R = np.eye(3, 9), 0.002**2 * np.eye(3)
    states, covariances = [x], [P]
    for k in range(1, len(track)):
        dt = track.times[k] - track.times[k - 1]
        F, drift = transition(dt)
        x, P = F @ x + drift, F @ P @ F.T + PLAIN.process.flight(np.array([dt]))[0]
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        innovation = track.positions[k] - x[:3]
        np.testing.assert_allclose(result.nis[k], innovation @ np.linalg.solve(S, innovation), rtol=1e-8)
        x, P = x + K @ innovation, P - K @ S @ K.T
        states.append(x)
        covariances.append(P)
    np.testing.assert_allclose(result.states, states, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(result.covariances, covariances, rtol=1e-7, atol=1e-12)
    assert result.status is Status.OK
    assert np.isnan(result.whitened[0]).all()


def batch_solution(track: Track) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 9) and covariances (n, 9, 9) of the dense least-squares problem over the whole track."""
    n = len(track)
    x0, P0 = start_of(track)
    A, b = [np.zeros((9, 9 * n))], [x0]
    A[0][:, :9] = np.eye(9)
    roots = [np.linalg.inv(np.linalg.cholesky(P0))]
    for k in range(1, n):
        dt = track.times[k] - track.times[k - 1]
        F, drift = transition(dt)
        row = np.zeros((9, 9 * n))
        row[:, 9 * k : 9 * k + 9], row[:, 9 * k - 9 : 9 * k] = np.eye(9), -F
        roots.append(np.linalg.inv(np.linalg.cholesky(PLAIN.process.flight(np.array([dt]))[0])))
        A.append(row)
        b.append(drift)
        row = np.zeros((3, 9 * n))
        row[:, 9 * k : 9 * k + 3] = np.eye(3)
        roots.append(np.eye(3) / 0.002)
        A.append(row)
        b.append(track.positions[k])
    whole = np.vstack([w @ a for w, a in zip(roots, A, strict=True)])
    right = np.concatenate([w @ c for w, c in zip(roots, b, strict=True)])
    scale = np.linalg.norm(whole, axis=0)
    Q, R = np.linalg.qr(whole / scale)
    states = np.linalg.solve(R, Q.T @ right) / scale
    root = np.linalg.inv(R) / scale[:, None]
    covariance = root @ root.T
    blocks = np.array([covariance[9 * k : 9 * k + 9, 9 * k : 9 * k + 9] for k in range(n)])
    return states.reshape(n, 9), blocks


def test_rts_pass_is_the_dense_batch_solution(linear):
    _, track = linear
    result = ExtendedKalmanFilter(AnalyticModel([Gravity()]), LOW, PLAIN, smooth=True).estimate(track)
    states, covariances = batch_solution(track)
    np.testing.assert_allclose(result.states, states, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(result.covariances, covariances, rtol=1e-6, atol=1e-11)
    filtered = ExtendedKalmanFilter(AnalyticModel([Gravity()]), LOW, PLAIN).estimate(track)
    np.testing.assert_allclose(result.states[-1], filtered.states[-1])
    assert (result.sigmas[:-1] <= filtered.sigmas[:-1] + 1e-12).all()


# --- motion ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "dt"),
    [
        ((0, 0, 0.3, 5, 0.5, 1, 10, 60, 20), 0.01),
        ((0, 0, 0.03, 5, 0.5, -2, 10, 60, 20), 0.01),
        ((0, 0, 0.3, 5, 0.5, -2, 10, 60, 20), 0.5),
        ((0, 0, 0.0201, 1, 0.5, -0.15, 0, 60, 20), 0.06),
        ((0, 0, 0.02, 1, 0.5, 0.0, 0, 60, 20), 0.03),
        ((0, 0, 0.018, 5, 0.5, -2, 10, 60, 20), 0.01),
        ((0, 0, 0.006, 1, 0.5, -0.1, 10, 60, 20), 0.01),
        ((0.99, 0, 0.04, 5, 0.5, -3.0, 0, 60, 20), 0.4),
    ],
    ids=["flight", "contact", "gap", "into rest", "rolling", "below", "below for good", "past the edge"],
)
def test_motion_is_the_rollout_and_its_jacobian(start, dt):
    model = nominal_model()
    surfaces = Surfaces(table_height=0.003, floor_height=-0.76, extent=(-1.0, 1.0, -1.0, 1.0))
    trackwise = AugmentedModel(model, ("flight.drag.k", "bounce.restitution.e"))
    state = trackwise.append(tensor(start), torch.tensor([0.12, 0.93], dtype=torch.float64))
    motion = advance_jacobian(trackwise, state[0].numpy(), dt, surfaces)

    def move(x):
        return advance(trackwise, x, torch.full((len(x),), dt, dtype=torch.float64), surfaces).detach()

    torch.testing.assert_close(torch.from_numpy(motion.after), move(state)[0], rtol=1e-9, atol=1e-9)
    step = 1e-6 * torch.eye(11, dtype=torch.float64)
    difference = ((move(state + step) - move(state - step)) / 2e-6).T
    # differences of 1e-6 in numbers up to 100, found to 1e-12: 1e-5 relative
    torch.testing.assert_close(torch.from_numpy(motion.jacobian), difference, rtol=1e-5, atol=2e-5)


# --- consistency -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many():
    """Filter and RTS estimates of tracks with a bounce each, and their truth."""
    rng = np.random.default_rng(11)
    model = nominal_model()
    cases = []
    for _ in range(40):
        start = SERVE + np.array([0, 0, 0.1, 1, 0.5, 0.7, 20, 30, 20]) * rng.standard_normal(9)
        start[2] = max(start[2], 0.1)
        truth, track = simulate(model, PLAIN, start, np.arange(60) * 0.01, rng)
        cases.append((truth, track))
    return model, cases


@pytest.mark.parametrize("smooth", [False, pytest.param(True, marks=pytest.mark.thorough)])
def test_nees_and_nis_lie_in_their_bands(many, smooth):
    model, cases = many
    estimator = ExtendedKalmanFilter(model, TABLE, PLAIN, smooth=smooth)
    last, middle, nis = [], [], []
    for truth, track in cases:
        result = estimator.estimate(track)
        errors = nees(result, truth)
        last.append(errors[-1])
        middle.append(errors[20])
        nis.append(result.nis[2:])
    assert inside(np.mean(last), 9, len(last))
    assert inside(np.mean(middle), 9, len(middle))
    if not smooth:
        assert inside(np.mean(nis), 3, np.size(nis))


def test_window_start_equals_the_sliding_window_and_uses_nothing_twice(flight):
    truth, track = flight
    window = SlidingWindow(nominal_model(), TABLE, PLAIN).estimate(track)
    result = run(track, initialise="window")
    np.testing.assert_array_equal(result.states[:5], window.states[:5])
    assert np.isnan(result.whitened[:5]).all()
    assert np.isfinite(result.whitened[5:]).all()
    assert nees(result, truth)[[5, 20, -1]].max() < chi2.ppf(0.999, 9)


def test_coefficients_are_learnt_on_the_way(rng):
    model = nominal_model()
    settings = Settings(
        process=ProcessNoise(0.05, 1.0, 0.005, 1.0),
        position_noise=(0.002,) * 3,
        coefficients={"bounce.restitution.e": 0.05},
    )
    parameters = dict(model.named_parameters())
    with torch.no_grad():
        parameters["bounce.restitution.e"].fill_(0.85)
    _, track = simulate(model, settings, SERVE, np.arange(60) * 0.01, rng, label=False)
    with torch.no_grad():
        parameters["bounce.restitution.e"].fill_(0.93)
    result = ExtendedKalmanFilter(model, TABLE, settings, smooth=True).estimate(track)
    assert result.coefficient_names == ("bounce.restitution.e",)
    assert result.cross_covariances.shape == (60, STATE_DIM, 1)
    sigma = float(np.sqrt(result.coefficient_covariance[0, 0]))
    assert sigma < 0.02
    assert abs(float(result.coefficients[0]) - 0.85) < 3 * sigma


def test_numbers_out_of_this_world_are_refused(flight):
    _, track = flight
    with pytest.raises(ValueError, match="x, y, z must be in m"):
        run(with_positions(track, track.positions * 1e90))


def test_a_filter_that_overflows_fails_with_a_status(flight):
    """A drag of that size leaves no number after the second sample."""
    _, track = flight
    model = nominal_model()
    with torch.no_grad():
        dict(model.named_parameters())["flight.drag.k"].fill_(1e200)
    result = ExtendedKalmanFilter(model, TABLE, PLAIN).estimate(track)
    assert result.status is Status.FAILED
    assert (np.linalg.eigvalsh(result.covariances)[:, 0] > 0).all()
    np.testing.assert_array_equal(result.states[:, POSITION], track.positions)


def test_unknown_start_is_refused():
    with pytest.raises(ValueError, match="initialise must be one of prior, window; got 'guess'"):
        ExtendedKalmanFilter(nominal_model(), TABLE, PLAIN, initialise="guess")


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured tracks at {DATA}; set BALLFG_DATA")
def test_measured_tracks():
    dataset = read_dataset(DATA / "aimy")
    settings = Settings.for_measured(nominal_model(), position_noise=(0.0015, 0.0007, 0.001))
    surfaces = Surfaces.table_tennis(dataset.info.table_height)
    estimator = ExtendedKalmanFilter(nominal_model(), surfaces, settings)
    nis, used = [], []
    for track, _ in zip(dataset, range(6), strict=False):
        result = estimator.estimate(track.until(track.times[0] + 0.6))
        assert result.status is Status.OK
        good = result.quality == Quality.GOOD
        nis += result.nis[good & np.isfinite(result.nis)].tolist()
        used += good.tolist()
    assert np.mean(used) > 0.97
    assert 1.0 < np.median(nis) < 4.0
