"""A ball that passes a surface, against integrals over all possible balls and against draws of them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import special
from scipy.stats import multivariate_normal, norm

from ballfg.dynamics import EFFECTS, AnalyticModel, Surfaces
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.motion.arrays import PreparedMotion
from ballfg.dynamics.motion.rollout import advance
from ballfg.estimation.settings import Settings
from ballfg.estimation.sides.gaussians import FAR_TAIL, GaussianMixture, _log_share_above
from ballfg.estimation.sides.hypotheses import ContactHypotheses, HypothesisModel, SampleMeasurement
from ballfg.estimation.sides.monitor import ContactMonitor
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.prior import PriorFactors
from ballfg.simulation import table_tennis

QUIET = Settings(process=ProcessNoise(1e-9, 1e-6, 1e-9, 0.0, 1e-6))
FALLING = np.array([0.0, 0.0, 0.034, 4.0, 0.3, -2.5, 10.0, 30.0, 5.0])
SIGMAS = np.array([1e-3, 1e-3, 2e-3, 0.03, 0.03, 0.03, 40.0, 40.0, 40.0])
DT = 0.006


def hypothesis_model(model=None) -> HypothesisModel:
    return HypothesisModel(model or table_tennis().model, Surfaces(0.0), QUIET)


def test_gaps_by_machine_code_and_by_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over a tilted surface that lies too high, whose rise travels with the state."""
    effects = [EFFECTS[name]() for name in ("gravity", "restitution", "table_tilt", "table_height")]
    ball = AugmentedModel(AnalyticModel(effects).requires_grad_(False), ("bounce.table_height.offset",))
    with torch.no_grad():
        for parameter in ball.parameters():
            parameter += 0.01
    means = np.random.default_rng(4).normal(size=(5, 10))
    found = hypothesis_model(ball).gaps(means, 0.3)
    monkeypatch.setattr(motion, "functions_of", lambda _: None)
    for own, right in zip(found, hypothesis_model(ball).gaps(means, 0.3), strict=True):
        np.testing.assert_allclose(own, right, rtol=1e-13, atol=1e-13)
    assert np.abs(found[1][:, [0, 1, 9]]).min() > 0.0


def test_flight_and_bounce_by_machine_code_and_by_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """States, their derivatives and contact times; one ball never comes down."""
    ball = AugmentedModel(table_tennis().model, ("bounce.restitution.e",))
    means = np.tile(np.append(FALLING, 0.9), (3, 1)) + 0.01 * np.random.default_rng(5).normal(size=(3, 10))
    means[2, 2:6] = 1.0, 4.0, 0.3, 2.5
    found = PreparedMotion(ball, 10)
    fast = (*found.fly(means, 0.01), *found.bounce(means, 0.02, 0.0))
    monkeypatch.setattr(motion, "functions_of", lambda _: None)
    slow = PreparedMotion(ball, 10)
    for own, right in zip(fast, (*slow.fly(means, 0.01), *slow.bounce(means, 0.02, 0.0)), strict=True):
        np.testing.assert_allclose(own[:2], right[:2], rtol=1e-10, atol=1e-10)
    assert np.isfinite(fast[3][:2]).all()
    assert np.isnan(fast[3][2])
    assert np.isnan(fast[2][2]).any()


@pytest.mark.parametrize("extent", [None, (0.0, 2.74, -0.7, 0.7)])
@pytest.mark.parametrize("floor", [None, -0.76])
def test_the_surface_below_one_ball_is_that_of_the_surfaces(extent, floor) -> None:
    """Above and below the table, beside it, and deep below the lowest surface."""
    surfaces, model = Surfaces(0.0, floor, extent), table_tennis().model
    places = [(x, 0.0, z) for x in (-1.0, 1.0) for z in (0.3, 0.001, -0.1, -0.7, -1.2)]
    states = np.zeros((len(places), 9))
    states[:, :3] = places
    own = [HypothesisModel(model, surfaces, QUIET).level(state) for state in states]
    moved = torch.from_numpy(states)
    assert own == surfaces.height_below(moved, model.surface_offset(moved)).tolist()


def test_a_gaussian_is_cut_as_an_integral_over_it_says() -> None:
    """Two numbers, the gap their difference: mean, covariance and weight of the part above, by sums over a grid."""
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    cut = GaussianMixture.single(np.array([0.3, 0.8]), covariance).truncated(np.array([-0.5]), np.array([[1.0, -1.0]]))
    x, y = np.meshgrid(np.linspace(-9, 9, 401), np.linspace(-7, 8, 401), indexing="ij")
    points = np.stack((x, y), axis=-1)
    apart = points - np.array([0.3, 0.8])
    weight = np.exp(-0.5 * np.einsum("abi,ij,abj->ab", apart, np.linalg.inv(covariance), apart)) * (x > y)
    weight /= weight.sum()
    mean = np.einsum("ab,abi->i", weight, points)
    spread = np.einsum("ab,abi,abj->ij", weight, points - mean, points - mean)
    np.testing.assert_allclose(cut.means[0], mean, atol=0.01)
    np.testing.assert_allclose(cut.covariances[0], spread, atol=0.02)
    assert np.exp(cut.log_weight) == pytest.approx(norm.cdf(-0.5 / np.sqrt(2.0)), rel=1e-9)


def test_merged_gaussians_have_the_moments_of_all() -> None:
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(3, 4, 4))
    mixture = GaussianMixture(np.log([0.2, 0.5, 1.3]), rng.normal(size=(3, 4)), roots @ roots.swapaxes(1, 2))
    shares = np.array([0.1, 0.25, 0.65])
    mean = shares @ mixture.means
    second = sum(w * (c + np.outer(m, m)) for w, m, c in zip(shares, mixture.means, mixture.covariances, strict=True))
    merged = mixture.merged()
    np.testing.assert_allclose(merged.means[0], mean)
    np.testing.assert_allclose(merged.covariances[0], second - np.outer(mean, mean), atol=1e-12)
    assert np.exp(merged.log_weight) == pytest.approx(2.0)


def test_weights_gain_the_density_of_what_a_factor_measured() -> None:
    """Of two Gaussians, by the densities of the measured velocity under each; mean and covariance as Kalman's."""
    rng = np.random.default_rng(4)
    roots = rng.normal(size=(2, 9, 9))
    means, covariances = rng.normal(size=(2, 9)), roots @ roots.swapaxes(1, 2)
    known = PriorFactors(np.array([0]), rng.normal(size=(1, 9)), np.diag(1.0 / np.arange(1.0, 10.0))[None])
    found = GaussianMixture(np.log([0.5, 0.5]), means, covariances).updated_by_factor(known, 0)
    noise = np.diag(np.arange(1.0, 10.0) ** 2)
    density = [multivariate_normal.logpdf(known.mean[0], m, c + noise) for m, c in zip(means, covariances, strict=True)]
    assert np.diff(found.log_weights) == pytest.approx(np.diff(density))
    for k in range(2):
        gain = covariances[k] @ np.linalg.inv(covariances[k] + noise)
        np.testing.assert_allclose(found.means[k], means[k] + gain @ (known.mean[0] - means[k]), atol=1e-9)
        np.testing.assert_allclose(found.covariances[k], covariances[k] - gain @ covariances[k], atol=1e-9)


@pytest.mark.parametrize("dt", [0.0062, 0.0068, 0.0074])
def test_both_sides_against_draws(dt: float) -> None:
    """30,000 balls rolled out and weighed by how well they fit the sample: chance, mean and sigmas of each side."""
    noise = 0.003
    position = np.array([4.0 * dt, 0.3 * dt, 0.019])
    hypotheses = ContactHypotheses.start(hypothesis_model(), FALLING, np.diag(SIGMAS**2)).step(
        dt, SampleMeasurement(position, np.full(3, noise))
    )
    flying, risen = hypotheses.sides
    rng = np.random.default_rng(3)
    drawn = torch.from_numpy(FALLING + SIGMAS * rng.standard_normal((30_000, 9)))
    with torch.no_grad():
        after = advance(table_tennis().model, drawn, torch.full((len(drawn),), dt, dtype=torch.float64), Surfaces(0.0))
    states = after.numpy()
    weights = np.exp(-0.5 * ((states[:, :3] - position) ** 2).sum(axis=1) / noise**2)
    up = states[:, 5] > 0.0
    chance = weights[up].sum() / weights.sum()
    assert 0.1 < chance < 0.9
    assert np.exp(risen.log_weights[0]) == pytest.approx(chance, abs=0.02)
    assert np.exp(flying.log_weights[0]) == pytest.approx(1.0 - chance, abs=0.02)
    for side, rows in ((flying, ~up), (risen, up)):
        own = weights[rows] / weights[rows].sum()
        mean = own @ states[rows]
        sigmas = np.sqrt(own @ (states[rows] - mean) ** 2)
        assert np.abs((side.means[0] - mean) / sigmas).max() < 0.15
        np.testing.assert_allclose(np.sqrt(np.diagonal(side.covariances[0])), sigmas, rtol=0.15)


@pytest.mark.parametrize("dt", [0.434, 0.443])
def test_a_ball_may_have_bounced_once_or_twice_in_a_gap(dt: float) -> None:
    """60,000 balls against the side that has bounced: its vertical velocity is that of both. By once alone it is
    3 m/s off with a sigma of 0.1 m/s where most balls have bounced twice."""
    noise, drawn = 0.003, FALLING + SIGMAS * np.random.default_rng(3).standard_normal((60_000, 9))
    with torch.no_grad():
        duration = torch.full((len(drawn),), dt, dtype=torch.float64)
        states = advance(table_tennis().model, torch.from_numpy(drawn), duration, Surfaces(0.0)).numpy()
    position = np.array([*np.median(states[:, :2], axis=0), 0.026])
    weights = np.exp(-0.5 * ((states[:, :3] - position) ** 2).sum(axis=1) / noise**2)
    weights /= weights.sum()
    assert 0.2 < weights[states[:, 5] > 0.0].sum() < 0.8
    start = ContactHypotheses.start(hypothesis_model(), FALLING, np.diag(SIGMAS**2))
    (bounced,) = start.step(dt, SampleMeasurement(position, np.full(3, noise))).sides[1:]
    mean = weights @ states
    sigmas = np.sqrt(weights @ (states - mean) ** 2)
    assert np.abs((bounced.means[0] - mean) / sigmas).max() < 0.35
    np.testing.assert_allclose(np.sqrt(np.diagonal(bounced.covariances[0])), sigmas, rtol=0.3)


SPIN_TIED = np.array([[1.0, 0.6, 0.0], [0.6, 0.5, 0.0], [0.0, 0.0, 1.0]])
"""Of a spin whose horizontal components differ and are tied to each other."""


def tied_covariance() -> np.ndarray:
    covariance = np.diag(SIGMAS**2)
    covariance[6:, 6:] = 80.0**2 * SPIN_TIED
    return covariance


def risen_after(mean: np.ndarray, covariance: np.ndarray, position: np.ndarray, noise: float) -> GaussianMixture:
    start = ContactHypotheses.start(hypothesis_model(), mean, covariance)
    return start.step(0.0167, SampleMeasurement(position, np.full(3, noise))).sides[1]


@pytest.mark.parametrize("angle", [0.5 * np.pi, 0.7])
def test_a_ball_in_a_turned_room_has_turned_hypotheses(angle: float) -> None:
    """Nodes along the axes of a triangular root would change the velocity by many of its standard deviations."""
    turn = np.eye(3)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    whole, position = np.kron(np.eye(3), turn), np.array([0.06, 0.006, 0.034])
    own = risen_after(FALLING, tied_covariance(), position, 1e-3)
    turned = risen_after(whole @ FALLING, whole @ tied_covariance() @ whole.T, turn @ position, 1e-3)
    sigmas = np.sqrt(np.diagonal(own.covariances[0]))
    assert np.abs((whole.T @ turned.means[0] - own.means[0]) / sigmas).max() < 1e-6
    np.testing.assert_allclose(
        (whole.T @ turned.covariances[0] @ whole) / np.outer(sigmas, sigmas),
        own.covariances[0] / np.outer(sigmas, sigmas),
        atol=1e-6,
    )


def test_a_spin_between_the_nodes_is_within_what_is_stated() -> None:
    """300 balls drawn with a wide spin and seen some 10 ms after the bounce to 1 mm: NEES as of nine numbers.

    Nodes without a spread of their own leave two in three off by a NEES above 30, with a mean above 1,000.
    """
    rng, covariance, noise = np.random.default_rng(8), tied_covariance(), 1e-3
    drawn = torch.from_numpy(rng.multivariate_normal(FALLING, covariance, size=300))
    with torch.no_grad():
        dt = torch.full((len(drawn),), 0.0167, dtype=torch.float64)
        truth = advance(table_tennis().model, drawn, dt, Surfaces(0.0)).numpy()
    nees = []
    for state in truth:
        side = risen_after(FALLING, covariance, state[:3] + noise * rng.standard_normal(3), noise)
        error = state - side.means[0]
        nees.append(error @ np.linalg.solve(side.covariances[0], error))
    assert np.mean(np.array(nees) > 30.0) < 0.06
    assert 7.5 < np.mean(nees) < 12.0


def test_a_ball_far_from_the_surface_is_left_to_its_estimator() -> None:
    monitor = ContactMonitor(hypothesis_model())
    high = FALLING + np.array([0, 0, 0.1, 0, 0, 0, 0, 0, 0])
    assert monitor.step((high, np.diag(SIGMAS**2)), DT, SampleMeasurement(), lambda count: False) is None


def test_a_bounce_that_is_still_to_come_has_not_happened() -> None:
    """An estimator explains samples by a bounce after the newest stamp, and its state has bounced: the ball flies."""
    monitor = ContactMonitor(hypothesis_model())
    high = FALLING + np.array([0, 0, 0.05, 0, 0, 0, 0, 0, 0])
    flown, _ = PreparedMotion(table_tennis().model, 9).fly(high[None], DT)
    measured = SampleMeasurement(flown[0, :3], np.full(3, 1e-3))
    told = monitor.step((high, np.diag(SIGMAS**2)), DT, measured, lambda count: True)
    assert told is not None
    assert not told.bounced
    np.testing.assert_allclose(told.mean, flown[0], atol=1e-6)


def test_a_sample_that_nothing_explains_is_not_believed_and_two_end_the_hypotheses() -> None:
    """A position 0.3 m off moves nothing; a second one means that something else has happened."""
    monitor, off = (
        ContactMonitor(hypothesis_model()),
        SampleMeasurement(np.array([0.024, 0.0018, 0.33]), np.full(3, 0.002)),
    )
    before = (FALLING, np.diag(SIGMAS**2))
    told = monitor.step(before, DT, off, lambda count: False)
    expected = ContactMonitor(hypothesis_model()).step(before, DT, SampleMeasurement(), lambda count: False)
    assert told is not None
    assert expected is not None
    np.testing.assert_array_equal(told.mean, expected.mean)
    assert monitor.step(before, DT, off, lambda count: False) is None


def test_a_side_is_told_as_long_as_the_estimator_takes_the_other() -> None:
    """Clearly bounced two samples ago: told while the estimator knows of no bounce, left to it once it does."""
    model = AnalyticModel([EFFECTS["gravity"](), EFFECTS["restitution"](e=0.9)])
    states, now = [FALLING], torch.from_numpy(FALLING)[None]
    for _ in range(3):
        with torch.no_grad():
            now = advance(model, now, torch.full((1,), 0.01, dtype=torch.float64), Surfaces(0.0))
        states.append(now[0].numpy().copy())
    for held in (False, True):
        monitor, told, covariance = ContactMonitor(hypothesis_model(model)), [], np.diag((0.1 * SIGMAS) ** 2)
        for step, (before, after) in enumerate(pairwise(states)):
            measured, since = SampleMeasurement(after[:3], np.full(3, 1e-4)), step if held else np.inf
            told.append(monitor.step((before, covariance), 0.01, measured, lambda count, since=since: count > since))
        assert told[0] is not None
        assert told[0].bounced
        assert (told[2] is None) == held


def test_the_share_above_a_cut_is_that_of_scipy() -> None:
    cuts = np.concatenate((np.linspace(-35.0, 40.0, 751), [FAR_TAIL - 1e-9, FAR_TAIL + 1e-9, 1e3, 1e150]))
    found = np.array([_log_share_above(cut) for cut in cuts.tolist()])
    np.testing.assert_allclose(found, special.log_ndtr(-cuts), rtol=1e-12, atol=0.0)
    assert _log_share_above(np.inf) == -np.inf
    assert _log_share_above(-np.inf) == 0.0
    assert np.isnan(_log_share_above(np.nan))
