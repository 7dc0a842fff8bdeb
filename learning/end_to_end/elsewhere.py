"""Prepares a residual network for other rooms: the extent of its training data, and the noise there."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.model import BASE, BallModel
from ballfg.dynamics.motion.paths import paths
from ballfg.dynamics.networks.fading import ABROAD, Fading, states_before_contacts
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.estimation import Smoother, estimate_noise, predict_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.noise.parameters import with_noise
from ballfg.learning.end_to_end.solving import Solved
from ballfg.learning.training_data import TrainingShot
from ballfg.state import STATE_DIM
from ballfg.tracks.noise import TrackNoise

ROOM_TRACKS: Final = 12  # Tracks of each room that tell its noise, in a few seconds
HORIZON: Final = 0.3  # s after the observed part at which a correction is judged
AVERAGED: Final = ("contact_velocity", "contact_tangential", "contact_spin")


def training_states(model: BallModel, shots: Sequence[TrainingShot], solved: Sequence[Solved]) -> list[Tensor]:
    """(n, 9) states at the stamps of each shot, from the estimate of its observed part."""
    found = []
    with torch.no_grad():
        for one in solved:
            shot = shots[one.number]
            times = torch.from_numpy(shot.track.times - shot.track.times[0])
            first = torch.from_numpy(one.solution.minimum.values.states[:1, :STATE_DIM])
            states = paths(model, first, times[None], shot.surfaces)[0]
            found.append(states[states.isfinite().all(-1)])
    return found


def fading_of(model: LearnedModel, tracks: Sequence[Tensor]) -> Fading:
    """The fading of a trained model's correction, from the states (n, 9) of each training track."""
    contacts = [states_before_contacts(states) for states in tracks]
    fading = Fading.of(tracks, contacts, model.radius)
    flying, bouncing = torch.cat(list(tracks)), torch.cat(contacts)
    assert model.base is not None
    with torch.no_grad():
        guess = model.base.after_bounce(bouncing)
        fading.measure(model.flight(flying)[0], model.contact(bouncing, guess) - guess)
    return fading


def noise_elsewhere(base: BallModel, shots: Sequence[TrainingShot]) -> TrackNoise | None:
    """The noise of motion, bounces and spins that whole tracks of the training rooms show about the analytic model.

    Acceleration is the least of the rooms: undetected hits raise it. Others are geometric means.

    Returns: its coefficients as the learned model names them; None where no track is long enough.
    """
    found = []
    for members in by_room(shots):
        settings = replace(members[0].settings, coefficients=coefficient_sigmas(base), launcher=None)
        tracks = [shot.track for shot in members]
        estimate = estimate_noise(base, members[0].surfaces, settings, tracks, errors=False)
        if estimate is not None:
            found.append(estimate.settings)
    if not found:
        return None

    def mean(values: Sequence[float]) -> float:
        return float(np.exp(np.mean(np.log(values)))) if min(values) > 0.0 else 0.0

    process = [settings.process for settings in found]
    values: dict[str, Any] = {name: mean([getattr(p, name) for p in process]) for name in AVERAGED}
    return TrackNoise(
        acceleration=min(p.acceleration for p in process),
        spin_prior=mean([settings.spin_prior for settings in found]),
        coefficients={BASE + n: mean([s.coefficients[n] for s in found]) for n in found[0].coefficients},
        **values,
    )


def strength_abroad(model: LearnedModel, noise: TrackNoise, shots: Sequence[TrainingShot]) -> float:
    """Share of the correction to use in other rooms: `ABROAD` if it helps in every room that trained, else 0.

    Abroad the coefficients of the base are estimated with each track, which already takes in much of what a correction
    does. So held-out tracks are predicted in that way, with and without the correction.
    """
    if not shots or model.fading is None:
        return 0.0
    for members in by_room(shots):
        settings = with_noise(replace(members[0].settings, coefficients=dict(noise.coefficients), launcher=None), noise)
        errors = []
        for strength in (0.0, ABROAD):
            model.fading.strength = strength
            errors.append(_log_errors(Smoother(model, members[0].surfaces, settings), members))
        model.fading.strength = 1.0
        if not np.nanmean(errors[1] - errors[0]) < 0.0:
            return 0.0
    return ABROAD


def by_room(shots: Sequence[TrainingShot]) -> list[list[TrainingShot]]:
    """At most `ROOM_TRACKS` shots of each room, spread over it."""
    rooms = defaultdict(list)
    for shot in shots:
        rooms[shot.room].append(shot)
    return [spread_over(members, len(members), ROOM_TRACKS) for members in rooms.values()]


def _log_errors(smoother: Smoother, shots: Sequence[TrainingShot]) -> Array:
    """(n,) logarithms of the root mean square errors over the next 0.3 s; NaN where there is nothing to predict."""
    seconds = {shot.name: float(shot.track.times[shot.observed - 1] - shot.track.times[0]) for shot in shots}
    tracks = (shot.track for shot in shots)
    found = predict_tracks(smoother, tracks, len(shots), lambda track: seconds[track.name], horizon=HORIZON)
    return np.array([0.5 * np.log(np.mean((r.positions - r.measured) ** 2)) if len(r.times) else np.nan for r in found])
