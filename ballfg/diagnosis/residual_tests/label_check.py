"""Finds the spin labels that contradict their flights, with probabilities.

All labels of a recording determine together what share of them is wrong and by how much right and wrong ones err, so
that a single doubtful one among many does not count. A minimum near a label is valid if the label is right, another one
if it may be wrong: sliding and gripping bounces have different minima (docs/derivations/diagnosis.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.effects import with_effects
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import EvaluationTrack, Holdout
from ballfg.diagnosis.generic_test import GenericTest, LabelCheck, LabelVerdict
from ballfg.diagnosis.search.evaluation import noise_about
from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.estimation import Settings, Smoother, Status, TrackProblem, dataset_settings
from ballfg.estimation.batch import estimate_tracks, map_tracks
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.smoother.problem import UNINFORMATIVE_SPIN
from ballfg.estimation.smoother.settle import initial_states
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Minimum
from ballfg.factors.linear.covariance import marginal_covariances
from ballfg.factors.loss import Loss
from ballfg.learning.calibration.coefficients import choose, values_of, with_values
from ballfg.learning.calibration.population import evidence, fit_population
from ballfg.state import SPIN
from ballfg.tracks import Track
from ballfg.tracks.noise import TrackNoise

LABEL: Final = "label"  # Kind of the test
NONE_WRONG: Final = 0.5
"""Prior probability that all labels are right; else all shares of wrong ones are equally probable."""
SHARES: Final = (np.arange(40) + 0.5) / 40  # Shares of wrong labels, the middles of fortieths
RIGHT: Final = np.exp(np.linspace(0.0, 1.4, 8))
"""Errors of right labels, as multiples of the stated ones: up to four times."""
RIGHT_SPREAD: Final = 0.7
"""Standard deviation of the logarithm of such a multiple: stated noise is known to a factor of two."""
WRONG: Final = np.exp(np.linspace(-1.1, 1.1, 9))
"""Errors of wrong labels, as multiples of `wrong_error`: a third to three times."""

MOST_ROUNDS = 5  # Largest number of fits of the population; usual are three, from coefficients far off
SETTLED = 0.1  # Change of the population's mean, in standard errors, below which it has converged
MINIMA = (Convergence.CONVERGED, Convergence.AT_KINK)


@dataclass(frozen=True)
class LabelPosterior:
    """Spin at the first sample given a label with an error of a given size."""

    label: Array  # (3,) rad/s
    error: float  # rad/s, standard deviation per axis of the label's error
    log_density: float  # Of the label given the samples, up to a constant of the track
    mean: Array  # (3,) rad/s
    covariance: Array  # (3, 3)

    def log_densities(self, errors: Array) -> Array:
        """Log densities (k,) of the label for other errors (k,) rad/s, with a Gaussian likelihood of the flight."""
        information = np.linalg.inv(self.covariance) - np.eye(3) / self.error**2
        values, axes = np.linalg.eigh(information)
        variances = 1.0 / np.maximum(values, UNINFORMATIVE_SPIN**-2)  # of the spin from the samples alone
        towards = axes.T @ (self.mean - self.label)
        away = (1.0 + variances / self.error**2) * towards  # from the label to that spin: the label has pulled

        def normal(error: Array) -> Array:
            total = variances + error[..., None] ** 2
            return np.asarray(-0.5 * (away**2 / total + np.log(total)).sum(axis=-1))

        return self.log_density + normal(np.asarray(errors)) - normal(np.asarray(self.error))

    @property
    def off(self) -> float:
        """rad/s, distance of the label from the spin."""
        return float(np.linalg.norm(self.label - self.mean))

    @property
    def off_sigma(self) -> float:
        """rad/s, standard deviation of the spin along the direction to the label."""
        way = self.label - self.mean
        return float(np.sqrt(way @ self.covariance @ way) / max(np.linalg.norm(way), np.finfo(float).tiny))


@dataclass(frozen=True)
class LabelledFlight:
    """The spin of a track's flight if its label is `right` within its stated error, and if it may be far `wrong`."""

    name: str
    right: LabelPosterior
    wrong: LabelPosterior


def check_labels(
    model: AnalyticModel, declared: AnalyticModel, holdout: Holdout, tracker: TrackNoise | None = None, *, jobs: int = 1
) -> LabelCheck | None:
    """Computes the verdicts on all spin labels of a dataset.

    Args:
        model: corrected by the diagnosis, fitted to the tracks.
        declared: the model before the diagnosis.
        holdout: the tracks of both halves.
        tracker: memory of the tracker and jitter of the stamps, if found.
        jobs: processes.
    Returns: None without labels.
    """
    return judged(label_evidence(model, declared, holdout, tracker, jobs=jobs))


def label_evidence(
    model: AnalyticModel, declared: AnalyticModel, holdout: Holdout, tracker: TrackNoise | None = None, *, jobs: int = 1
) -> list[LabelledFlight]:
    """The labels with the spins of their flights, from the arguments of `check_labels`."""
    parts = (*holdout.search_tracks, *holdout.held_out_tracks)
    tracks = sorted((p for p in parts if p.track.spin_label is not None), key=lambda p: p.track.name)
    if not tracks:
        return []
    ball, settings = scattering_model(model, declared, tracks, holdout, tracker, jobs=jobs)
    return labelled_flights(ball, holdout.surfaces, settings, tracks, jobs)


def scattering_model(
    model: AnalyticModel,
    declared: AnalyticModel,
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    tracker: TrackNoise | None = None,
    *,
    jobs: int = 1,
) -> tuple[AnalyticModel, Settings]:
    """A corrected model with refitted coefficients, and the settings for predictions with it.

    If bounces scatter, the diagnosis' own deterministic fit adapts coefficients and spins to them, and right labels
    seem wrong. Here each track with a spin label is smoothed with process noise, and the declared coefficients of
    flight and bounce are the mean of a population; added effects and values that differ between tracks stay.
    """
    plain = with_effects(model)
    plain.variations = model.variations
    usual = dataset_settings(holdout.dataset, plain)  # no noise is stated in this model
    names = [n for n in declared_free(declared) if not n.startswith("measurement.") and n not in model.variations]
    if names:
        plain = _of_population(plain, declared, names, tracks, holdout, usual, jobs)
    plain.noise = noise_about(plain, tracks, holdout.dataset, tracker, jobs=jobs)
    settings = dataset_settings(holdout.dataset, plain)
    # the labels' estimated error includes wrong labels: right ones have the dataset's error
    return plain, replace(settings, spin_label_noise=usual.spin_label_noise)


def _of_population(
    model: AnalyticModel,
    declared: AnalyticModel,
    names: Sequence[str],
    tracks: Sequence[EvaluationTrack],
    holdout: Holdout,
    settings: Settings,
    jobs: int,
) -> AnalyticModel:
    chosen, mean = choose(declared, names), values_of(model, names)
    priors = {**settings.coefficients, **dict(zip(names, chosen.sigma.tolist(), strict=True))}
    for _ in range(MOST_ROUNDS):
        moving = with_values(model, names, mean)
        smoother = make_estimator("smoother", moving, holdout.surfaces, replace(settings, coefficients=priors))
        estimates = estimate_tracks(smoother, (part.track for part in tracks), len(tracks), jobs)
        found = []
        for estimate in (e for e in estimates if e.status is Status.OK):
            columns = [estimate.coefficient_names.index(name) for name in names]
            covariance = estimate.coefficient_covariance[np.ix_(columns, columns)]
            found.append(evidence(estimate.coefficients[columns], covariance, mean, chosen.sigma))
        if not found:
            return model
        population = fit_population(found, chosen.start, chosen.sigma, chosen.low, chosen.high)
        before, mean = mean, population.mean
        if np.abs((mean - before) / population.sigma).max() < SETTLED:
            break
    return with_values(model, names, mean)


def judged(flights: Sequence[LabelledFlight]) -> LabelCheck | None:
    """The verdicts on labels with their flights; None without labels."""
    if not flights:
        return None
    right = np.stack([f.right.log_densities(RIGHT * f.right.error) for f in flights])
    errors = [np.hypot(RIGHT[:, None] * f.right.error, WRONG * f.wrong.error) for f in flights]  # of wrong labels
    wrong = np.stack([f.wrong.log_densities(e.ravel()) for f, e in zip(flights, errors, strict=True)])
    probability, p_all_right = _mixture(right, wrong)
    verdicts = [
        LabelVerdict(f.name, p, f.wrong.off, f.wrong.off_sigma)
        for f, p in zip(flights, probability.tolist(), strict=True)
    ]
    return LabelCheck(p_all_right, tuple(sorted(verdicts, key=lambda v: (-v.probability, -v.off))))


def label_test(check: LabelCheck, before: LabelCheck | None = None) -> GenericTest:
    """The check as a test; before: of the declared model, for the share of contradicted labels."""
    now = len(check.contradicted)
    whole = now if before is None else max(now, len(before.contradicted))
    return GenericTest(LABEL, check.where, check.p_all_right, now / whole if whole else 0.0)


def _mixture(right: Array, wrong: Array) -> tuple[Array, float]:
    """Probability (n,) that each label is wrong, and that none is.

    Args: right: (n, r) log densities of labels that err by `RIGHT`.  wrong: (n, r w) of wrong ones.
    """
    wrong = wrong.reshape(*right.shape, -1)
    stated = np.exp(-0.5 * (np.log(RIGHT) / RIGHT_SPREAD) ** 2)
    prior = np.log(stated / stated.sum())
    least = np.maximum(right.max(axis=1), wrong.max(axis=(1, 2)))[:, None]
    as_right, as_wrong = right - least, wrong - least[..., None]
    one, other = np.log1p(-SHARES), np.log(SHARES)
    each_wrong = other + as_wrong[..., None]  # (n, r, w, shares)
    either = np.logaddexp(one + as_right[:, :, None, None], each_wrong)
    some = either.sum(axis=0) + prior[:, None, None] - np.log(len(WRONG) * len(SHARES)) + np.log1p(-NONE_WRONG)
    none = as_right.sum(axis=0) + prior + np.log(NONE_WRONG)
    top = max(some.max(), none.max())
    weights, sure = np.exp(some - top), np.exp(none - top).sum()
    total = weights.sum() + sure
    return (np.exp(each_wrong - either) * weights).sum(axis=(1, 2, 3)) / total, float(sure / total)


def wrong_error(labels: Array, least: float) -> float:
    """rad/s, standard deviation per axis of a wrong label's error, as if it belonged to another shot.

    Args: labels: (n, 3) rad/s.  least: rad/s, for labels that are all alike.
    """
    usual = np.median((labels**2).sum(axis=-1)) / 2.366  # median of a chi-square with three degrees of freedom
    return max(float(np.sqrt(2.0 * usual)), least)


def labelled_flights(
    model: AnalyticModel, surfaces: Surfaces, settings: Settings, tracks: Sequence[EvaluationTrack], jobs: int = 1
) -> list[LabelledFlight]:
    """The labels of tracks with their flights; tracks without a minimum are left out.

    Args: settings: process noise, and the standard deviation of right labels.  tracks: with spin labels.
    """
    labels = np.array([part.track.spin_label for part in tracks]).reshape(-1, 3)
    far = wrong_error(labels, settings.spin_prior) if len(tracks) else 0.0
    settings = replace(settings, label_loss=Loss("squared"), launcher=None)
    task = partial(_labelled_flight, model, surfaces, settings, far)
    found = map_tracks(task, (part.track for part in tracks), len(tracks), jobs)
    return [flight for flight in found if flight is not None]


def _labelled_flight(
    model: AnalyticModel, surfaces: Surfaces, settings: Settings, far: float, track: Track
) -> LabelledFlight | None:
    ball = model.for_track(track)
    if ball.measures_plainly:
        smoother = Smoother(ball, surfaces, settings)
    else:
        inverse = InvertMeasurement(Smoother, ball, surfaces, settings)
        track, smoother = inverse.undo(track).track, inverse.smoother
    if smoother.settings.spin_label(track) is None:
        return None  # the model reads the label as a spin of no ball
    bare = smoother.problem(replace(track, labels={}))
    flight = smoother.settle(bare)  # with the spin that the flight alone shows best
    near, wide = (
        TrackProblem(track, smoother.model, replace(smoother.settings, spin_label_noise=error), bare.segmentation)
        for error in (smoother.settings.spin_label_noise, far)
    )
    events, label = flight.events, near.settings.spin_label(track)
    labelled = near.start(initial_states(track, events.contacts, events.segmentation, near.model, label))
    right = _lowest(smoother.optimizer, near.graph(events), [flight.minimum.values, labelled])
    if right is None:
        return None
    wrong = _lowest(smoother.optimizer, wide.graph(events), [flight.minimum.values, right.values])
    if wrong is None:
        return None
    return LabelledFlight(track.name, _posterior(near, right), _posterior(wide, wrong))


def _lowest(optimizer: LevenbergMarquardt, graph: BallGraph, starts: Sequence[Values]) -> Minimum | None:
    """The lowest minimum of a graph from some starts; None if the lowest point is no minimum."""
    lowest = min((optimizer.minimize(graph, start) for start in starts), key=lambda found: found.error)
    return lowest if lowest.convergence in MINIMA and lowest.step is not None else None


def _posterior(problem: TrackProblem, minimum: Minimum) -> LabelPosterior:
    label = problem.settings.spin_label(problem.track)
    assert label is not None
    assert isinstance(label.sigma, float)  # of a label, not of a group
    assert minimum.step is not None
    root = minimum.step.root
    covariance = marginal_covariances(root).states[0][SPIN, SPIN]
    log_density = -(minimum.error + root.log_determinant + 3.0 * np.log(label.sigma))
    return LabelPosterior(label.spin, label.sigma, log_density, minimum.values.states[0, SPIN], covariance)
