"""Shares of the expected squared error of predictions, against simulated repetitions and a Kalman filter in numpy."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.estimation import Smoother
from ballfg.estimation.noise.linear_filter import LinearFilter, Noise
from ballfg.estimation.noise.linear_tracks import LinearTracks, linearise
from ballfg.estimation.noise.sources import SOURCES, squares_by_source
from ballfg.simulation import MeasurementNoise
from ballfg.state import POSITION, SPIN
from tests.estimation.noise.in_torch import leaves, measure, motion, prior

VELOCITY_PRIOR = 10.0
REPETITIONS = 4000
NUMBERS = {
    "position": (1.0, 1.3, 0.8),
    "memory": (4e-6, 1e-6, 2e-6),
    "memory_time": 0.03,
    "stamp_jitter": 1e-7,
    "process": (0.2, 3.0, 0.05, 0.2, 5.0, 0.4, 0.2),
    "spin_label": 20.0,
    "spin_prior": 60.0,
    "coefficients": (1.0,),
}
ALONE = {
    "observed": {"position": (1.0, 1.3, 0.8)},
    "spin": {"spin_label": 20.0, "spin_prior": 60.0},
    "coefficients": {"coefficients": (1.0,)},
    "tracker": {"memory": (4e-6, 1e-6, 2e-6), "stamp_jitter": 1e-7},
    "bounces": {"process": (0.0, 0.0, 0.05, 0.2, 5.0, 0.4, 0.2)},
    "motion": {"process": (0.2, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0)},
    "samples": {"position": (1.0, 1.3, 0.8)},
}
"""The numbers of each source; all others are zero."""


@pytest.fixture(scope="module")
def linear(recorded):
    """Two tracks of different lengths with a bounce, coefficients, and a label of the spin on one of them."""
    model, surfaces, settings, tracks = recorded(MeasurementNoise(position=0.003, memory=0.002), tracks=4)
    parts = [t.until(float(t.times[0]) + 0.8 + 0.1 * k) for k, t in enumerate(tracks)]
    found = linearise(Smoother(model, surfaces, settings), parts)
    assert len(found.coefficient_sigmas)
    assert (found.kicks[:2, :, 2] != 0.0).any(axis=(1, 2, 3)).all()
    own = {f.name: getattr(found, f.name) for f in fields(found)}
    two = {name: value if name == "coefficient_sigmas" else value[:2] for name, value in own.items()}
    return LinearTracks(**(two | {"labelled": np.array([True, False])}))


def noise_of(numbers):
    """The noise with some numbers; the others are zero, and a memory lasts."""
    given = {name: np.zeros_like(value) for name, value in NUMBERS.items()} | {"memory_time": 0.03} | numbers
    return Noise(**{name: np.array([value], dtype=np.float64) for name, value in given.items()})


def samples_of(linear):
    """The first 40 % of the times are observed, of the rest all good samples are predicted."""
    observed = linear.times <= 0.4 * linear.times[:, -1:]
    return observed, linear.used & ~observed


@dataclass(frozen=True)
class Problem:
    """One track: steps (n - 1, w, w), gathered (n - 1, w, w), prior (w, w), measured (n, 3, 3), observe (3, w)."""

    steps: Array
    gathered: Array
    prior: Array
    measured: Array
    observe: Array

    @classmethod
    def of(cls, linear, row, noise):
        tracks = LinearFilter(linear, VELOCITY_PRIOR)
        given = leaves(noise)
        steps, gathered = (x[row].detach().numpy() for x in motion(tracks, given))
        whole = np.diag(np.concatenate((prior(tracks, given)[row].detach().numpy(), noise.memory[0])))
        return cls(steps, gathered, whole, tracks.measured(noise)[row], measure(tracks).numpy())


def filtered(problem, seen):
    """Gains (n, w, 3), zero without an update, and covariances (n, w, w) after each sample."""
    covariance, gains, covariances = problem.prior, [], []
    for k, updates in enumerate(seen):
        if k:
            covariance = problem.steps[k - 1] @ covariance @ problem.steps[k - 1].T + problem.gathered[k - 1]
        h = problem.observe
        gain = updates * covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + problem.measured[k])
        left = np.eye(len(covariance)) - gain @ h
        covariance = left @ covariance @ left.T + gain @ problem.measured[k] @ gain.T
        gains.append(gain)
        covariances.append(covariance)
    return np.array(gains), np.array(covariances)


def drawn(rng, covariance):
    """(REPETITIONS, m) normal numbers."""
    values, vectors = np.linalg.eigh(covariance)
    return rng.standard_normal((REPETITIONS, len(covariance))) @ (vectors * np.sqrt(values.clip(min=0.0))).T


def repeated(alone, gains, predicted, source, rng):
    """m^2, mean over repetitions of the squared errors of predictions, with errors of one source only."""
    truth = drawn(rng, alone.prior)
    mean, total = np.zeros_like(truth), 0.0
    biases = np.zeros_like(alone.observe)
    biases[:, -3:] = np.eye(3)
    for k, gain in enumerate(gains):
        if k:
            truth = truth @ alone.steps[k - 1].T + drawn(rng, alone.gathered[k - 1])
            mean = mean @ alone.steps[k - 1].T
        silent = predicted[k] if source == "observed" else not predicted[k] and source == "samples"
        error = 0.0 if silent else drawn(rng, alone.measured[k])
        measured = truth @ alone.observe.T + error
        if predicted[k]:  # of the position alone: the tracker's lasting error is not predicted
            total += ((measured - mean @ (alone.observe - biases).T) ** 2).sum() / REPETITIONS
        mean = mean + (measured - mean @ alone.observe.T) @ gain.T
    return total


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("row", [0, 1])
def test_a_source_alone_errs_by_its_share(linear, source, row):
    """Gains stay those of the whole noise. The spin has three numbers: 4000 repetitions know its square to 1.3 %."""
    observed, predicted = samples_of(linear)
    share = squares_by_source(linear, noise_of(NUMBERS), VELOCITY_PRIOR, observed, predicted)[row]
    gains, _ = filtered(Problem.of(linear, row, noise_of(NUMBERS)), (linear.used & observed)[row])
    alone = Problem.of(linear, row, noise_of(ALONE[source]))
    start = np.arange(len(alone.prior)) < SPIN.start if source == "observed" else np.full(len(alone.prior), False)
    prior = alone.prior * np.where(start | (np.arange(len(alone.prior)) >= SPIN.start), 1.0, 0.0)
    alone = replace(alone, prior=prior)
    found = repeated(alone, gains, predicted[row], source, np.random.default_rng(3))
    assert float(share[SOURCES.index(source)]) == pytest.approx(found, rel=0.05)


def test_the_shares_add_up_to_the_covariances(linear):
    """Of the filter in numpy, with the samples' own noise, and the part that a sample shares with the prediction."""
    observed, predicted = samples_of(linear)
    noise = noise_of(NUMBERS)
    shares = squares_by_source(linear, noise, VELOCITY_PRIOR, observed, predicted)
    for row in range(len(linear)):
        problem = Problem.of(linear, row, noise)
        _, covariances = filtered(problem, (linear.used & observed)[row])
        biases = slice(problem.observe.shape[1] - 3, None)
        of_ball = np.trace(covariances[:, POSITION, POSITION], axis1=1, axis2=2)
        common = 2.0 * np.trace(covariances[:, POSITION, biases], axis1=1, axis2=2)
        own = np.trace(problem.measured, axis1=1, axis2=2) + float(noise.memory.sum())
        whole = (of_ball + common + own)[predicted[row]].sum()
        assert float(shares[row].sum()) == pytest.approx(whole, rel=1e-8)
    assert (shares > 0.0).all()


def test_without_a_memory_its_share_is_that_of_the_stamps(linear):
    observed, predicted = samples_of(linear)
    noise = noise_of(NUMBERS | {"memory": (0.0, 0.0, 0.0)})
    shares = squares_by_source(linear, noise, VELOCITY_PRIOR, observed, predicted)
    still = squares_by_source(linear, replace(noise, stamp_jitter=np.zeros(1)), VELOCITY_PRIOR, observed, predicted)
    tracker = SOURCES.index("tracker")
    assert float(shares[:, tracker].min()) > 0.0
    assert float(np.abs(still[:, tracker]).max()) == 0.0
