"""From a fit to a model that others can use: fitted coefficients, noise and launcher, and the process noise.

Process noise is how far measured balls stray from a model from one moment to the next. The fit is deterministic, so
that all motion beside the model goes to the residual. Predictions need that motion as process noise. Too little of it
makes them overconfident; too much makes them ignore the observed part. The usual process noise of measured tracks is
scaled as a whole, to the scale at which predictions of the search half have the largest likelihood.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch

from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.diagnosis.search.hypothesis import with_effects
from ballfg.dynamics import AnalyticModel, SpinEmbedding, Trained
from ballfg.estimation import dataset_settings, dataset_surfaces
from ballfg.estimation.settings import MEASURED
from ballfg.tracks import Dataset

SCALES = (0.03, 0.1, 0.3, 1.0)
"""Factors on the usual process noise that are tried; the likelihood is flat between neighbours."""
MOST_PREDICTED = 15
"""Tracks that are predicted to choose the scale, evenly over those given."""
SCALED = ("acceleration", "spin", "contact_velocity", "contact_tangential", "contact_spin")
"""Numbers of the process noise that are scaled; the noise of a hit stays."""
LEAST_SPIN_SIGMA = 1.0
"""rad/s. A launcher is not taken to repeat its spin better than that."""


@dataclass(frozen=True)
class PredictiveModel:
    """A model with the process noise that predicts best, and its errors on tracks that it was fitted to."""

    model: AnalyticModel
    errors: Errors


def calibrated_model(fit: Fit, embedding: SpinEmbedding) -> AnalyticModel:
    """The fitted model, for estimates and predictions; embedding: names the launcher settings of the fit."""
    model = with_effects(fit.problem.model)  # a copy
    parameters = dict(model.named_parameters())
    with torch.no_grad():
        for name, value in fit.unknowns.values.items():
            if name in parameters:
                parameters[name].fill_(value)
    model.variations = fit.variations()
    unlabelled = not fit.problem.stretches.labelled.all()
    learned = SpinEmbedding(embedding.labels, embedding.categories, torch.from_numpy(fit.unknowns.launcher))
    model.trained = Trained(
        position_scale=float(np.sqrt((fit.noise.position**2).mean())),
        launcher=learned.requires_grad_(False) if unlabelled else None,
        spin_noise=max(fit.noise.spin, LEAST_SPIN_SIGMA) if unlabelled else fit.noise.label,
    )
    return model


def with_process_noise(
    model: AnalyticModel, tracks: Sequence[EvaluationTrack], dataset: Dataset, jobs: int = 1
) -> PredictiveModel:
    """The model with the process noise that predicts tracks best.

    Args: model: with `trained`, which is replaced.  tracks: those that it was fitted to.
    """
    tried: list[Errors] = []
    some = tracks[:: math.ceil(len(tracks) / MOST_PREDICTED)]
    trained = cast(Trained, model.trained)
    for scale in SCALES:
        model.trained = _scaled(trained, scale)
        settings = dataset_settings(dataset, model)
        tried.append(prediction_errors(model, some, dataset_surfaces(dataset), settings, jobs))
        if len(tried) > 1 and tried[-1].log_likelihood < tried[-2].log_likelihood:
            break  # the likelihood has one maximum
    best = int(np.argmax([errors.log_likelihood for errors in tried]))
    model.trained = _scaled(trained, SCALES[best])
    return PredictiveModel(model, tried[best])


def _scaled(trained: Trained, scale: float) -> Trained:
    return replace(trained, process_noise={name: scale * getattr(MEASURED, name) for name in SCALED})
