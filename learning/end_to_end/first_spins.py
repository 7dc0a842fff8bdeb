"""Initialises the spins of launcher settings from the analytic model's estimates of the training tracks.

Without spin labels only the flight shows the spin. From no spin, learning needs many epochs to reach 150 rad/s, and a
group of shots may end with the wrong sign. The spin with which an analytic model explains a whole track is right
within some 10 rad/s.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.analytic import AnalyticModel, coefficient_sigmas
from ballfg.dynamics.networks.spin_embedding import SPIN_UNIT, SpinEmbedding
from ballfg.estimation import Smoother, Status
from ballfg.learning.shots import TrainingShot
from ballfg.state import SPIN, VELOCITY

SPIN_PRIOR: Final = 150.0  # rad/s, standard deviation of the prior: launchers reach this spin
LEAST_SPEED: Final = 0.5  # m/s of horizontal motion below which a launch has no forward direction


def begin_with_tracks(embedding: SpinEmbedding, shots: Iterable[TrainingShot], model: AnalyticModel) -> None:
    """Set an embedding to the spins that a model finds in whole tracks, by least squares over their settings.

    Shots with a spin label, or without all settings, are skipped; where none is left the embedding stays as it is.
    Coefficients of the model that vary from track to track are estimated too.
    """
    settings, spins = [], []
    for shot in shots:
        told = None if shot.settings.launcher is None else shot.settings.launcher.settings(shot.track)
        spin = None if told is None else _spin(shot, model)
        if told is not None and spin is not None:
            settings.append(told)
            spins.append(spin)
    if settings:
        weight = np.linalg.lstsq(np.stack(settings), np.stack(spins), rcond=None)[0].T / SPIN_UNIT
        with torch.no_grad():
            embedding.weight.copy_(torch.from_numpy(weight))


def _spin(shot: TrainingShot, model: AnalyticModel) -> Array | None:
    """(3,) rad/s about forward, across and up at the first sample; None for a failed estimate or a slow launch."""
    wide = replace(shot.settings, launcher=None, coefficients=coefficient_sigmas(model), spin_prior=SPIN_PRIOR)
    estimate = Smoother(model, shot.surfaces, wide).estimate(shot.track)
    velocity, spin = estimate.states[0, VELOCITY], estimate.states[0, SPIN]
    speed = float(np.hypot(velocity[0], velocity[1]))
    if estimate.status is not Status.OK or speed < LEAST_SPEED:
        return None
    x, y = velocity[:2] / speed
    return np.array([x * spin[0] + y * spin[1], x * spin[1] - y * spin[0], spin[2]])
