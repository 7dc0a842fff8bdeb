"""The online estimator's window: what a cut forgets, how much memory it holds, how it is built anew after failures."""

import gc

import gtsam
import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.estimation.online.newest import has_bounced
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.interval import IntervalMaker
from ballfg.estimation.online.windows.rows import LinearRows, write_linear
from ballfg.estimation.online.windows.window_filter import WindowFilter, carried_with_bias
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.motion import FLIGHT
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import COEFFICIENTS
from ballfg.factors.bridge import STATE_KEY, Bridge
from ballfg.factors.correlated_noise import BiasedPositionFactors, BiasFactors
from ballfg.factors.loss import Loss
from ballfg.factors.prior import coefficient_prior, spin_label
from ballfg.tracks import Track
from tests.estimation.online.streams import (
    BOUNCING,
    FLYING,
    LIVE,
    LIVE_BOUNCE,
    NOWHERE,
    SIGMA,
    TABLE,
    NetworkModel,
    feed,
    make_track,
    settings,
)


@pytest.mark.parametrize("start", [FLYING, BOUNCING])
@pytest.mark.parametrize("coefficients", [False, True])
def test_a_cut_window_forgets_nothing_that_matters(start, coefficients):
    model = nominal_model()
    chosen = (
        Settings.for_measured(model, position_noise=(SIGMA,) * 3, loss=Loss())
        if coefficients
        else settings(loss=Loss())
    )
    surfaces, allowed = (NOWHERE, LIVE) if start is FLYING else (TABLE, LIVE_BOUNCE)
    track, _ = make_track(start, n=70, surfaces=surfaces)
    expected = Smoother(model, surfaces, chosen).estimate(track)
    online = Online(model, surfaces, chosen, lag=20)
    feed(online, track)
    assert online.window.first >= 40
    late = online.window.first
    off = (online.window.states - expected.states[late:]) / expected.sigmas[late:]
    assert np.abs(off[-1]).max() < allowed
    result = online.estimate(track)
    assert result.states.shape == (70, 9)
    assert np.abs((result.states[-1] - expected.states[-1]) / expected.sigmas[-1]).max() < allowed
    assert result.sigmas[-1] == pytest.approx(expected.sigmas[-1], rel=0.01 if start is FLYING else 0.2)
    assert len(result.contacts) == len(expected.contacts)
    assert [c.interval for c in result.contacts] == [c.interval for c in expected.contacts]
    assert len(result.quality) == 70


def count_objects():
    """Bridges alive, and all objects."""
    gc.collect()
    objects = gc.get_objects()
    return sum(type(o) is Bridge for o in objects), len(objects)


def test_memory_is_flat_on_an_endless_stream():
    """Shot after shot, half of them after a gap that restarts: nothing grows once the window is full.

    What the window holds goes up and down and repeats itself after eight shots, which are 240 samples.
    """
    track, _ = make_track(FLYING, n=30, surfaces=NOWHERE)
    online = Online(
        nominal_model(), NOWHERE, Settings.for_measured(nominal_model(), position_noise=(SIGMA,) * 3), lag=15
    )
    sizes, clock = [], 0.0
    for shot in range(19):
        for t, z in zip(track.times, track.positions, strict=True):
            assert not online.push(clock + float(t), z).rebuilt
            assert len(online.window) <= 30
        clock += 0.4 + (0.05 if shot % 2 else 1.0)
        sizes.append(count_objects())
    bridges, counts = np.array(sizes[3:]).T
    assert bridges.max() < 4 * 30
    assert abs(counts[8:].max() - counts[:8].max()) < 100  # less than one object in two samples
    assert online.window.isam.getFactorsUnsafe().size() < 4 * 30
    assert online.window.isam.size() < 2 * 30


def test_a_sample_that_nothing_links_to_the_last_has_no_velocity():
    track, _ = make_track(FLYING, n=10, surfaces=NOWHERE)
    online = Online(nominal_model(), NOWHERE, settings())
    for t, z in zip(track.times.tolist(), track.positions, strict=True):
        in_another_unit = online.push(1000.0 * t, z)
        assert in_another_unit.status is Status.NO_VELOCITY
        np.testing.assert_allclose(np.sqrt(np.diag(in_another_unit.joint))[3:6], 20.0, rtol=1e-6)
    after = online.push(1000.0 * t + 0.01, z)
    assert after.status is Status.OK


def test_rebuilds_after_gtsam_failed():
    """An update that throws leaves iSAM2 half-updated: the same keys cannot be added again."""
    track, _ = make_track(FLYING, n=40, surfaces=NOWHERE)
    online, undisturbed = (Online(nominal_model(), NOWHERE, settings(loss=Loss())) for _ in range(2))
    feed(undisturbed, track)
    for k, (t, z) in enumerate(zip(track.times.tolist(), track.positions, strict=True)):
        if k == 25:
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            loose = gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
            graph.push_back(gtsam.CustomFactor(loose, [STATE_KEY + 25], _one_row))
            values.insert(STATE_KEY + 25, np.zeros(9))
            with pytest.raises(RuntimeError, match="Indetermin"):
                online.window.isam.update(graph, values)
        state = online.push(t, z)
        assert state.rebuilt == (k == 25)
        assert state.status is (Status.OK if k else Status.NO_VELOCITY)
    assert len(online.window) == 40
    assert online.window.states[-1] == pytest.approx(undisturbed.window.states[-1], abs=1e-3)


def _one_row(_, values, jacobians):
    if jacobians is not None:
        jacobians[0] = np.eye(1, 9)
    return np.zeros(1)


def test_rebuilds_after_cut_and_failure():
    track, _ = make_track(BOUNCING, n=60)
    model = nominal_model()
    chosen = Settings.for_measured(model, position_noise=(SIGMA,) * 3)
    online = Online(model, TABLE, chosen, lag=15)
    feed(online, track)
    before = online.window.states.copy()
    sigma = np.sqrt(np.diag(online.window.newest_covariance))[:9]
    online.window.start_anew(online._samples)
    assert np.abs((online.window.states[-1] - before[-1]) / sigma).max() < 0.1


class Broken(NetworkModel):
    """A model that gives nonsense from some speed on."""

    limit = np.inf

    def rates(self, state):
        acceleration, spin = super().rates(state)
        return acceleration * torch.nan if bool((state[..., 3].abs() > self.limit).any()) else acceleration, spin


@pytest.mark.filterwarnings("ignore:Broken runs in torch")
def test_a_window_that_cannot_be_solved_says_so():
    track, _ = make_track(FLYING, n=20, surfaces=NOWHERE)
    model = Broken()
    online = Online(model, NOWHERE, settings())
    states = feed(online, track.until(0.1))
    model.limit = 1.0
    state = online.push(0.11, track.positions[11])
    assert states[-1].status is Status.OK
    assert state.rebuilt
    assert state.status is Status.FAILED
    assert state.state[:3] == pytest.approx(track.positions[11])
    assert len(online.window) == 1
    model.limit = np.inf
    assert online.push(0.12, track.positions[12]).status is Status.OK


def test_a_bias_is_carried_beside_the_state_and_in_front_of_the_coefficients():
    """x' = f(x) + F dx + G dc and b' = exp(-dt / T) b, each block where state, bias and coefficients stand."""
    rng, own = np.random.default_rng(3), settings(memory=(0.002, 0.003, 0.004), memory_time=0.05)
    piece, bias, dt = rng.normal(size=(9, 1 + 9 + 2)), rng.normal(size=3), 0.01
    covariance = np.diag(rng.uniform(1.0, 2.0, 9))
    carried, noise = carried_with_bias(piece, covariance, bias, dt, own)
    state, shift, coefficients = rng.normal(size=9), rng.normal(size=3), rng.normal(size=2)
    found = carried @ np.concatenate(([1.0], state, shift, coefficients))
    decay = np.exp(-dt / 0.05)
    np.testing.assert_allclose(found[:9], piece[:, 0] + piece[:, 1:10] @ state + piece[:, 10:] @ coefficients)
    np.testing.assert_allclose(found[9:], decay * (bias + shift))
    np.testing.assert_allclose(noise[:9, :9], covariance)
    np.testing.assert_allclose(np.diag(noise)[9:], np.square([0.002, 0.003, 0.004]) * (1.0 - decay**2))


@pytest.mark.parametrize("memory", [0.0, 0.004])
@pytest.mark.parametrize("far", [1e-3, 0.3])
def test_a_step_of_the_filter_is_a_textbook_s(memory, far):
    """Prediction, a sample with the error of its stamp, and an update that a robust loss weighs; bias and coefficients.

    The gain is written with the inverse of the innovation's covariance.
    """
    rng, loss = np.random.default_rng(7), Loss("huber", 2.0)
    own = settings(memory=(memory,) * 3, memory_time=0.05, stamp_jitter=1e-3, loss=loss)
    w = 12 if memory else 9
    interval = IntervalMaker(nominal_model(), own.process).make(0, FLIGHT, 0.01)
    piece, point, mean = rng.normal(size=(9, 12)), rng.normal(size=w), rng.normal(size=w + 2)
    root = 0.01 * rng.normal(size=(w + 2, w + 2))
    covariance, shared = root @ root.T, rng.normal(size=2)
    carried, noise = piece, interval.covariance
    if memory:
        carried, noise = carried_with_bias(piece, noise, point[9:], 0.01, own)
    F, Q = np.eye(w + 2), np.zeros((w + 2, w + 2))
    F[:w], Q[:w, :w] = carried[:, 1:], noise
    expected = F @ (mean - np.concatenate((point, shared)))
    expected[:w] += carried[:, 0]
    expected[w:] = mean[w:]
    spread, H = F @ covariance @ F.T + Q, np.zeros((3, w + 2))
    H[:, :3] = np.eye(3)
    if memory:
        H[:, 9:12] = np.eye(3)
    sample = Sample(0.01, H @ expected + far, np.full(3, 2e-3))
    way = 1e-3 * expected[3:6]
    R = np.diag(sample.stated**2) + np.outer(way, way)
    innovation = np.linalg.solve(np.linalg.cholesky(H @ spread @ H.T + R), np.full(3, far))
    R /= float(loss.weight(np.array([np.linalg.norm(innovation)]))[0])
    gain = spread @ H.T @ np.linalg.inv(H @ spread @ H.T + R)
    found = WindowFilter(own, w).step(piece, point, mean, shared, covariance, interval, sample)
    np.testing.assert_allclose(found[0], expected + gain @ np.full(3, far), rtol=1e-9)
    np.testing.assert_allclose(found[1], spread - gain @ H @ spread, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[2], innovation, rtol=1e-9)
    np.testing.assert_allclose(sample.velocity, expected[3:6])


def test_positions_may_be_columns_of_a_larger_table():
    track, _ = make_track(FLYING, n=12, surfaces=NOWHERE)
    table = np.asfortranarray(track.positions)
    strided = Track(track.times, table, sigmas=np.asfortranarray(np.full((12, 3), SIGMA)))
    plain = Track(track.times, track.positions, sigmas=np.full((12, 3), SIGMA))
    found, expected = (Online(nominal_model(), NOWHERE, settings()).estimate(one) for one in (strided, plain))
    np.testing.assert_array_equal(found.states, expected.states)


def test_linear_rows_about_other_points_are_those_of_the_factors():
    """A position and a prior with robust losses, the link of two biases and what is known of the coefficients."""
    rng, w, p = np.random.default_rng(8), 12, 2
    one, loss = np.zeros(1, dtype=np.int64), Loss("cauchy", 1.5)
    position, sigma = rng.normal(size=(1, 3)), np.full((1, 3), 0.1)
    batches = [
        BiasedPositionFactors(one, position, sigma, loss=loss),
        spin_label(one, rng.normal(size=(1, 3)), np.full((1, 3), 2.0), Loss("huber", 0.5)),
        BiasFactors(one, np.array([0.01]), np.array([0.002, 0.003, 0.004]), 0.02),
        coefficient_prior(np.array([0.1, 0.9]), np.array([0.01, 0.02])),
    ]
    rows = LinearRows(batches, w, p, columns=28)
    state, after, shared = rng.normal(size=w), rng.normal(size=w), rng.normal(size=p)
    found, begin = np.zeros((rows.dim, 28)), 0
    here = np.zeros(1, dtype=np.int64)
    write_linear([rows], here, here, np.stack((state, after)), shared, found)
    for batch in batches:
        points = [shared if v == COEFFICIENTS else (state, after)[k] for k, v in enumerate(batch.variables[0].tolist())]
        inputs = tuple(x[None] if batch.sees_biases or len(x) == p else x[None, :9] for x in points)
        (residual,), blocks = batch.compute(slice(None), inputs)
        expected, place = np.zeros((batch.dim, 28)), 0
        for variable, (block,) in zip(batch.variables[0].tolist(), blocks, strict=True):
            at = 2 * w if variable == COEFFICIENTS else place
            expected[:, at : at + block.shape[1]] = block
            place += w
        expected[:, -1] = -residual
        expected *= np.sqrt(batch.loss.weight(np.array([np.linalg.norm(residual)])))
        np.testing.assert_allclose(found[begin : begin + batch.dim], expected, rtol=1e-9, atol=1e-9)
        begin += batch.dim
    assert begin == rows.dim


def test_whether_the_ball_has_bounced_in_the_last_intervals():
    model, (track, _) = nominal_model(), make_track(BOUNCING)
    online = Online(model, TABLE, settings())
    feed(online, track)
    bounced = [k for k, sample in enumerate(online._samples) if sample.motion.heights]
    since = len(online._samples) - bounced[-1]  # intervals from the one with the bounce to the newest, both counted
    assert since > 2
    found = [has_bounced(online._samples, count) for count in (1, since - 1, since, since + 1)]
    assert found == [False, False, True, True]


def hopping(low: float, n: int, rng: np.random.Generator) -> tuple[np.ndarray, list[float], np.ndarray]:
    """Stamps (n,) s, moments of bounces and states (n, 6) of a ball that hops in vacuum, in closed form.

    Args: low: m, height of the centre at a bounce.
    """
    times, start, moments, rows = 0.0067 * np.arange(n), 0.0, list[float](), list[np.ndarray]()
    height, speed, e = low + rng.uniform(0.2, 0.3), rng.uniform(0.0, 1.0), 0.93
    while start < times[-1]:
        lasts = (speed + np.sqrt(speed**2 + 2 * 9.81 * (height - low))) / 9.81
        since = times[(times >= start) & (times < start + lasts)] - start
        zero = 0.0 * since
        z, vz = height + speed * since - 0.5 * 9.81 * since**2, speed - 9.81 * since
        rows.append(np.stack((0.3 * (since + start), zero, z, zero + 0.3, zero, vz), axis=1))
        start, height, speed = start + lasts, low, e * (9.81 * lasts - speed)
        moments.append(start)
    return times, [moment for moment in moments if moment < times[-1]], np.concatenate(rows)


def test_states_that_left_the_window_know_their_bounces():
    """The table is 5 mm off its nominal height, 2 ms of a bounce: the estimate finds it, the segmentation cannot."""
    model = nominal_model()
    with torch.no_grad():
        for name in ("flight.drag.k", "bounce.friction.mu"):
            model.get_parameter(name).zero_()
    chosen, odd = Settings.for_measured(model, position_noise=(SIGMA,) * 3), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        times, moments, true = hopping(0.02 - 0.003 - 0.005, 400, rng)
        track = Track(times, true[:, :3] + SIGMA * rng.standard_normal((len(times), 3)), name="hops")
        estimate = Online(model, TABLE, chosen).estimate(track)
        assert np.abs(np.array([contact.time for contact in estimate.contacts]) - moments).max() < 1.2e-3
        beside = np.unique(np.searchsorted(times, moments)[:, None] - [1, 0])
        odd += (np.abs(estimate.states[:, :6] - true) / estimate.sigmas[:, :6])[beside].max(axis=1).tolist()
    assert max(odd) < 5.0
