"""From a track and the events in it to a factor graph.

Every interval between two samples gets one dynamics factor: free flight, flight through the contacts found in it, or
rest on a surface; a hit adds its jump to the process noise. An interval that nothing links (a long gap with a hit in
it) gets none. Every sample gets a position factor, or in a track that cameras saw every sighting a camera factor; the
first state of each linked piece gets a prior.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.integrate import steps_over
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.observations.sighted import SightedTrack
from ballfg.estimation.segmentation import Contact, Quality, Segmentation
from ballfg.estimation.settings import Settings, sample_sigmas, spin_start
from ballfg.estimation.smoother.motion import motions_of
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.camera import FIXED, CameraFactors
from ballfg.factors.dynamics import ContactFactors, FlightFactors, RestFactors
from ballfg.factors.graph import BallGraph
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.noise import Kicks
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import CoefficientPriorFactors, PriorFactors, spin_label, spin_prior, state_prior
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track

Array = NDArray[np.float64]

START_POSITION_SIGMA = 5.0
"""m, prior of the first position about its measurement: wide enough to say nothing."""
QUALITY_SIGMA = {Quality.WIDE: 4.0, Quality.SHIFTED: 20.0, Quality.OUTLIER: 200.0}
"""Standard deviation of a sample that is not good, in multiples of a good one's."""


@dataclass(frozen=True)
class Events:
    """What happens in a track: its segmentation, with the contacts as refined so far."""

    contacts: tuple[Contact, ...]
    segmentation: Segmentation


def trackwise_model(model: BallModel, settings: Settings, track: Track | None = None) -> BallModel:
    """The model, augmented by the coefficients that are estimated for each track.

    Args:
        model: the ball.
        settings: name the coefficients, and the cameras whose time offsets are estimated.
        track: for one that cameras saw, these offsets are among the coefficients.
    Raises: ValueError: if the settings name a camera that the track does not have.
    """
    offsets = {}
    if isinstance(track, SightedTrack):
        names = track.sightings.cameras
        for name in settings.time_offsets:
            if name not in names:
                raise ValueError(f"time_offsets must name cameras of the track, {', '.join(names)}; got {name!r}")
            offsets[PASSENGER + name] = -float(track.moved[names.index(name)])
    plain = not (settings.coefficients or offsets)
    return model if plain else AugmentedModel(model, tuple(settings.coefficients), offsets)


PASSENGER = "time_offset."
"""What the name of a camera's time offset begins with among the passengers of an `AugmentedModel`."""


def coefficient_means(model: BallModel, settings: Settings) -> Array:
    """(p,) the model's own values of the coefficients that are estimated."""
    parameters = dict(model.named_parameters())
    return np.array([float(parameters[name].detach()) for name in settings.coefficients])


def coefficient_sigmas(model: BallModel, settings: Settings) -> Array:
    """(p,) prior standard deviations of the coefficients of a model from `trackwise_model`, time offsets last."""
    offsets = model.passengers if isinstance(model, AugmentedModel) else ()
    own = [settings.time_offsets[name.removeprefix(PASSENGER)] for name in offsets]
    return np.array([*settings.coefficients.values(), *own])


def effective_sigmas(track: Track, segmentation: Segmentation, settings: Settings) -> Array:
    """(n, 3) m: standard deviations of the samples, larger for those that are wide, shifted or outliers."""
    sigma = sample_sigmas(settings, len(track), track.sigmas)
    for quality, factor in QUALITY_SIGMA.items():
        sigma[segmentation.quality == quality] *= factor
    return sigma


def build_graph(track: Track, model: BallModel, events: Events, sigma: Array, settings: Settings) -> BallGraph:
    """The factor graph of one track.

    Args:
        track: stamps, positions, labels.
        model: the ball, from `trackwise_model`.
        events: contacts, hits, rests.
        sigma: (n, 3) m, of the positions; those of a track that cameras saw take no part.
        settings: noise and priors.
    Returns: the graph; its first kind holds what was measured.
    """
    kinds: list[FactorBatch] = [_measured(track, model, sigma, settings)]
    kinds += _dynamics(track.times, model, events, settings)
    kinds += _priors(track, events.segmentation, settings)
    if isinstance(model, AugmentedModel):
        kinds.append(CoefficientPriorFactors(model, coefficient_sigmas(model, settings)))
    return BallGraph(tuple(kinds))


def _measured(track: Track, model: BallModel, sigma: Array, settings: Settings) -> FactorBatch:
    """What was measured: positions, or the pixels of a track that cameras saw."""
    if not isinstance(track, SightedTrack):
        return PositionFactors(np.arange(len(track)), track.positions, sigma, settings.loss)
    seen = track.sightings
    return CameraFactors(
        track.state,
        seen.camera,
        seen.pixels,
        seen.covariances,
        track.bank,
        track.delay,
        _columns(seen.cameras, model),
        settings.sighting_loss,
    )


def _columns(cameras: tuple[str, ...], model: BallModel) -> NDArray[np.int64] | None:
    """(cameras,) which coefficient is each camera's time offset; None where none is estimated."""
    if not (isinstance(model, AugmentedModel) and model.passengers):
        return None
    names = (*model.names, *model.passengers)
    return np.array([names.index(PASSENGER + c) if PASSENGER + c in names else FIXED for c in cameras])


def contact_kinds(graph: BallGraph) -> list[ContactFactors]:
    """The graph's contact factors."""
    return [kind for kind in graph.kinds if isinstance(kind, ContactFactors)]


def _dynamics(times: Array, model: BallModel, events: Events, settings: Settings) -> list[FactorBatch]:
    """One factor per linked interval, in batches that share a motion and a number of integration steps."""
    dt = np.diff(times)
    motions = motions_of(replace(events.segmentation, contacts=events.contacts), times)
    covariance = settings.process.flight(dt)
    groups: defaultdict[tuple[str, int], list[int]] = defaultdict(list)
    for i, motion in enumerate(motions):
        if motion.times or motion.hit:
            covariance[i] = motion.covariance(dt[i : i + 1], settings.process)[0]
        if not motion.linked:
            continue
        if motion.heights:
            groups["contact", len(motion.heights)].append(i)
        elif motion.rest is not None:
            groups["rest", 0].append(i)
        else:
            groups["flight", steps_over(float(dt[i]))].append(i)
    kinds: list[FactorBatch] = []
    for (motion_kind, _), members in groups.items():
        rows = np.array(members)
        kicks = Kicks(
            np.array([motions[i].kick_times(float(dt[i])) for i in members]),
            np.array([motions[i].hit for i in members]),
        )
        if motion_kind == "contact":
            heights = np.array([motions[i].heights for i in members])
            kinds.append(ContactFactors(model, rows, dt[rows], covariance[rows], heights, kicks))
        elif motion_kind == "rest":
            resting = np.array([motions[i].rest for i in members])
            kinds.append(RestFactors(model, rows, dt[rows], covariance[rows], resting, kicks))
        else:
            kinds.append(FlightFactors(model, rows, dt[rows], covariance[rows], kicks))
    return kinds


def _priors(track: Track, segmentation: Segmentation, settings: Settings) -> list[FactorBatch]:
    """Wide priors on the first state of each piece, and what is known of its spin.

    Of the first one that is the label, where there is one, or what the launcher's settings say; else the spin prior.
    """
    kinds: list[FactorBatch] = []
    launch = None if settings.launcher is None else settings.launcher.settings(track)
    if settings.launcher is not None and launch is not None:
        spread = np.full((1, 3), settings.launcher.sigma)
        embedding, loss = settings.launcher.embedding, settings.label_loss
        kinds.append(LauncherSpinFactors(np.array([0]), launch[None], embedding, spread, loss))
        kinds.append(_wide_prior(0, track.positions[0], settings))
    else:
        kinds += start_priors(0, track.positions[0], settings.spin_label(track), settings)
    for interval in segmentation.restarts:
        kinds += start_priors(int(interval) + 1, track.positions[int(interval) + 1], None, settings)
    return kinds


def start_priors(state: int, position: Array, label: SpinLabel | None, settings: Settings) -> list[FactorBatch]:
    """Priors on a state that nothing leads up to.

    Args:
        state: its index.
        position: (3,) m, as measured.
        label: what is known of the spin; None for the spin prior.
        settings: spreads and losses.
    """
    spin, spread = spin_start(label, settings)
    where, spreads = np.array([state]), np.full((1, 3), spread)
    if label is None:
        about = spin_prior(where, spin[None], spreads, settings.spin_loss)
    else:
        about = spin_label(where, spin[None], spreads, settings.label_loss)
    return [_wide_prior(state, position, settings), about]


def _wide_prior(state: int, position: Array, settings: Settings) -> PriorFactors:
    mean, sigma = np.zeros(STATE_DIM), np.empty(STATE_DIM)
    mean[POSITION] = position
    sigma[POSITION], sigma[VELOCITY], sigma[SPIN] = START_POSITION_SIGMA, settings.velocity_prior, UNINFORMATIVE_SPIN
    return state_prior(state, mean, sigma)


UNINFORMATIVE_SPIN = 2000.0
"""rad/s, prior about zero beside the label or the spin prior, should their robust loss set them aside."""


def initial_values(states: Array, model: BallModel, settings: Settings) -> Values:
    """A start for the minimisation from states (n, 9)."""
    if isinstance(model, AugmentedModel):
        return Values(states, np.append(coefficient_means(model.model, settings), np.zeros(len(model.passengers))))
    return Values(states, np.zeros(0))
