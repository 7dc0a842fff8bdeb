"""Builds the factor graph of one track from its observations and its events.

Every interval between two samples gets one dynamics factor: free flight, flight through its contacts, or rest on a
surface; a hit adds its jump to the process noise. An interval without a link (a long gap with a hit in it) gets none.
Every observation of the track gives its factors; the first state of each linked piece gets a prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.kept_model import augmented
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.observations.observation import Context, Observation, Unknowns, unknowns_of
from ballfg.estimation.observations.positions import Positions
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact, Quality, Segmentation
from ballfg.estimation.settings import Settings, sample_sigmas, spin_start, total_sigmas
from ballfg.estimation.smoother.motion import TrackDynamics
from ballfg.estimation.smoother.second_look.low_hops import LowHops
from ballfg.factors import prior
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.correlated_noise import BIAS_DIM, BiasFactors, BiasStartFactors
from ballfg.factors.dynamics import model_width
from ballfg.factors.graph import BallGraph
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

LEAST_SPIN_PRIOR = 60.0
"""rad/s, of a ball after a hit, however well a launcher repeats its spin."""
UNINFORMATIVE_SPIN = 2000.0
"""rad/s, prior about zero beside the label or the spin prior, in case their robust loss rejects them."""
START_POSITION_SIGMA = 5.0
"""m, prior of the first position about its measurement: wide enough to carry no information."""
QUALITY_SIGMA = {Quality.WIDE: 4.0, Quality.SHIFTED: 20.0, Quality.OUTLIER: 200.0}
"""Standard deviation of a sample that is not good, in multiples of a good one's."""


@dataclass(frozen=True)
class Events:
    """The events of a track: its segmentation, with refined contacts.

    Attributes:
        spans: s, by the interval of contacts, from when to when they may be; without an entry anywhere in the interval.
    """

    contacts: tuple[Contact, ...]
    segmentation: Segmentation
    spans: Mapping[int, tuple[float, float]] | None = None


def trackwise_model(model: BallModel, settings: Settings) -> BallModel:
    """The model, augmented by the coefficients that are estimated with each track."""
    return augmented(model, tuple(settings.coefficients))


def coefficient_means(model: BallModel, settings: Settings) -> Array:
    """(p,) the model's own values of the estimated coefficients."""
    return np.array([numbers_of(model).value(name) for name in settings.coefficients])


def effective_sigmas(track: Track, segmentation: Segmentation, settings: Settings) -> Array:
    """(n, 3) m: standard deviations of the samples' white errors, larger for wide or shifted samples and outliers."""
    settings = settings.for_track(track)
    sigma = sample_sigmas(settings, len(track), track.sigmas)
    if (segmentation.quality == Quality.GOOD).all():
        return sigma
    whole = total_sigmas(settings, sigma, partial(window_velocities, track.times, track.positions))
    for quality, factor in QUALITY_SIGMA.items():
        bad = segmentation.quality == quality
        sigma[bad] = factor * whole[bad]
    return sigma


class TrackProblem:
    """The minimisation of one track: built once, solved for all tried arrangements of events.

    Args:
        track: stamps, positions, observations, labels.
        model: the ball, without the estimated coefficients.
        settings: noise and priors.
        segmentation: the events to start from.
        sigma: (n, 3) m, standard deviations of the positions; None: those of `effective_sigmas`.
        hops: the low hops compatible with the segmentation, if searched.

    Attributes:
        ball: the model with the estimated coefficients.
        observations: of the track, positions among them.
        one_view: True if one camera alone saw the ball.
        unknowns: those of the observations; they follow the coefficients of the ball.
        observed: the factors of each observation, by its name.
        added: further factors, at first empty; append to it before the problem is solved.

    Raises: ValueError: if the settings give an observation unknowns that it does not have.
    """

    def __init__(
        self,
        track: Track,
        model: BallModel,
        settings: Settings,
        segmentation: Segmentation,
        sigma: Array | None = None,
        hops: tuple[LowHops, ...] | None = None,
    ) -> None:
        self.track, self.hops = track, hops
        self.model = model
        self.settings = settings = settings.for_track(track)
        self.segmentation = segmentation
        self.sigma = effective_sigmas(track, segmentation, settings) if sigma is None else sigma
        self.ball = trackwise_model(model, settings)
        measured = () if track.rough else (Positions(track.positions),)
        self.observations: tuple[Observation, ...] = (*measured, *track.observations)
        self.one_view = track.one_view
        self.unknowns: Unknowns = unknowns_of(self.observations, settings)
        self.width = model_width(self.ball)
        columns = {name: self.width + k for k, name in enumerate(self.unknowns.names)}
        self.biased = settings.has_memory
        self.context = Context(track, model, settings, self.sigma, columns, _velocities(track, segmentation, settings))
        self.observed = {one.name: one.batch(self.context) for one in self.observations}
        self.added: list[FactorBatch] = []
        self._dynamics = TrackDynamics(track.times, self.ball, settings.process)

    @cached_property
    def _launch(self) -> list[FactorBatch]:
        """The priors on the first state, the same for all arrangements of events."""
        return _first_priors(self.track, self.settings)

    @property
    def coefficient_sigmas(self) -> Array:
        """(p + q,) prior standard deviations of the ball's coefficients and of the unknowns, in their own units."""
        return np.append(np.array(list(self.settings.coefficients.values())), self.unknowns.sigmas)

    def graph(self, events: Events) -> BallGraph:
        """The factor graph for some events."""
        batches: list[FactorBatch] = [*self.beside(events).values(), *self.added]
        batches += self._dynamics.factors(replace(events.segmentation, contacts=events.contacts))
        batches += (*self._launch, *_priors_after_hits(self.track, events.segmentation, self.settings))
        for observation in self.observations:
            batches += observation.priors()
        if self.biased:
            sigma, dt = self.settings.bias_sigmas, np.diff(self.track.times)
            batches.append(BiasStartFactors(np.array([0]), sigma))
            batches.append(BiasFactors(np.arange(len(dt)), dt, sigma, self.settings.memory_time))
        own, others = self.coefficient_sigmas[: self.width], len(self.unknowns.names)
        if self.width:
            batches.append(prior.CoefficientPriorFactors(self.ball, own, others))
        if others:
            batches.append(prior.coefficient_prior(self.unknowns.means, self.unknowns.sigmas, self.width))
        return BallGraph(tuple(batches))

    def beside(self, events: Events) -> dict[str, FactorBatch]:
        """The factors of each observation, by its name, on states of their own side of each contact."""
        anywhere = {c.interval: tuple(self.track.times[c.interval : c.interval + 2].tolist()) for c in events.contacts}
        spans = anywhere | dict(events.spans or {})
        return {one.name: one.beside_contacts(self.observed[one.name], self.track, spans) for one in self.observations}

    def notes(self, events: Events) -> tuple[str, ...]:
        """A note on each observation with measurements that are not used."""
        beside = self.beside(events)
        counts = {one: one.left_out(beside[one.name]) for one in self.observations}
        return tuple(
            f"{count} of {len(one)} measurements '{one.name}' are not used: they lie too near a contact to know their "
            "side of it, or too far from the samples on that side"
            for one, count in counts.items()
            if count
        )

    def judged(self, estimate: Estimate) -> Estimate:
        """The estimate, with what each observation says of it."""
        for observation in self.observations:
            estimate = observation.judged(estimate)
        return estimate

    def start(self, states: Array) -> Values:
        """Initial values: states (n, 9), the model's own coefficients, unknowns and biases of zero."""
        means = coefficient_means(self.model, self.settings)
        biases = np.zeros((len(states), BIAS_DIM)) if self.biased else None
        return Values(states, np.append(means, np.zeros(len(self.unknowns.names))), biases)

    def innovations(self, events: Events, values: Values, covariances: Covariances | None) -> dict[str, Array]:
        """Innovations (m, dim) whitened, at a minimum, by name of the observation; NaN without covariances."""
        if covariances is None:
            return {name: np.full((len(batch), batch.dim), np.nan) for name, batch in self.observed.items()}
        beside = self.beside(events)
        return {
            one.name: one.innovations(self.context, beside[one.name].linearize(values), values, covariances)
            for one in self.observations
        }


def _velocities(track: Track, segmentation: Segmentation, settings: Settings) -> Array | None:
    """(n, 3) m/s, along which the errors of stamps displace the samples; None if stamps are exact."""
    if settings.stamp_jitter == 0.0:
        return None
    breaks = np.array([c.interval for c in segmentation.contacts], dtype=np.int64)
    breaks = np.unique(np.concatenate((breaks, segmentation.hits, segmentation.restarts)))
    return window_velocities(track.times, bridged_positions(track, segmentation), breaks)


def bridged_positions(track: Track, segmentation: Segmentation) -> Array:
    """(n, 3) m: measured positions, with lines between neighbours in place of outliers and shifted runs."""
    trusted = segmentation.quality <= Quality.WIDE
    if trusted.all() or not trusted.any():
        return track.positions.copy()
    return np.stack([np.interp(track.times, track.times[trusted], p[trusted]) for p in track.positions.T], axis=-1)


def _first_priors(track: Track, settings: Settings) -> list[FactorBatch]:
    """A wide prior on the first state, and one on its spin by the label, the launcher or the settings."""
    launcher = settings.launcher
    launch = None if launcher is None else launcher.settings(track)
    if launcher is None or launch is None:
        return start_priors(0, track.positions[0], settings.spin_label(track), settings)
    spread, loss = np.full((1, 3), launcher.sigma), settings.label_loss
    about = LauncherSpinFactors(np.array([0]), launch[None], launcher.embedding, spread, loss)
    return [about, _wide_prior(0, track.positions[0], settings)]


def _priors_after_hits(track: Track, segmentation: Segmentation, settings: Settings) -> list[FactorBatch]:
    """Wide priors on the first state of each further piece, and on its spin, which is not that of the launcher."""
    if not len(segmentation.restarts):
        return []
    anew = replace(settings, spin_prior=max(settings.spin_prior, LEAST_SPIN_PRIOR))
    begins = (segmentation.restarts + 1).tolist()
    return [one for k in begins for one in start_priors(k, track.positions[k], None, anew)]


def start_priors(state: int, position: Array, label: SpinLabel | None, settings: Settings) -> list[FactorBatch]:
    """Priors on a state without a link to a previous one, at a measured position (3,) m, with a label of its spin."""
    known, where = spin_start(label, settings), np.array([state])
    if known.measured:
        about: prior.PriorFactors = prior.spin_label(where, known.spin[None], known.sigmas[None], settings.label_loss)
    else:
        about = prior.spin_prior(where, known.spin[None], known.sigmas[None], settings.spin_loss, known.axes)
    return [_wide_prior(state, position, settings), about]


def rolling_priors(state: int, position: Array, radius: float, settings: Settings) -> list[FactorBatch]:
    """Priors on a state without a link to a previous one of a ball of a radius (m) that rolls on a level surface."""
    root = rolling_axes(radius)[SPIN] / rolling_spread(settings)[:, None]
    rolls = prior.PriorFactors(np.array([state]), np.zeros((1, STATE_DIM)), root[None])
    return [_wide_prior(state, position, settings), rolls]


def rolling_axes(radius: float) -> Array:
    """(9, 9) from a state to one with the spin less that of rolling without slip, of a ball of a radius (m)."""
    axes: Array = np.eye(STATE_DIM)
    axes[SPIN.start, VELOCITY.start + 1], axes[SPIN.start + 1, VELOCITY.start] = 1.0 / radius, -1.0 / radius
    return axes


def rolling_spread(settings: Settings) -> Array:
    """(3,) rad/s, standard deviations of the spin of a rolling ball about that without slip; any about the vertical."""
    return np.array([settings.process.contact_spin, settings.process.contact_spin, settings.spin_prior])


def _wide_prior(state: int, position: Array, settings: Settings) -> prior.PriorFactors:
    mean, sigma = np.zeros(STATE_DIM), np.empty(STATE_DIM)
    mean[POSITION] = position
    sigma[POSITION], sigma[VELOCITY], sigma[SPIN] = START_POSITION_SIGMA, settings.velocity_prior, UNINFORMATIVE_SPIN
    return prior.state_prior(state, mean, sigma)
