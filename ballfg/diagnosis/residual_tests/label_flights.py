"""Computes the probability of a spin label given its flight, for several sizes of the label's error.

The density of a label is a ratio of two marginal likelihoods, as docs/derivations/diagnosis.md derives.
A minimum near the label is valid if the label is right, another one if it may be wrong: sliding and gripping bounces
have different minima.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.estimation import Settings, Smoother, TrackProblem
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.smoother.problem import UNINFORMATIVE_SPIN
from ballfg.estimation.smoother.settle import initial_states
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Minimum
from ballfg.factors.linear.covariance import marginal_covariances
from ballfg.factors.loss import Loss
from ballfg.state import SPIN
from ballfg.tracks import Track

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
