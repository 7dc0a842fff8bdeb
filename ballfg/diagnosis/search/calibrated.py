"""From a fit to a model that others can use: coefficients as fitted, noise and launcher beside them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch

from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Value
from ballfg.diagnosis.search.hypothesis import with_effects
from ballfg.dynamics import AnalyticModel, SpinEmbedding, Trained

LEAST_SPIN_SIGMA = 1.0
"""rad/s. A launcher is not taken to repeat its spin better than that."""


def calibrated_model(fit: Fit, embedding: SpinEmbedding) -> AnalyticModel:
    """The fitted model, for estimates and predictions; embedding: names the launcher settings of the fit."""
    model = with_effects(fit.problem.model)  # a copy
    parameters = dict(model.named_parameters())
    with torch.no_grad():
        for name, value in fit.unknowns.values.items():
            parameters[name].fill_(value)
    unlabelled = not fit.problem.stretches.labelled.all()
    learned = SpinEmbedding(embedding.labels, embedding.categories, torch.from_numpy(fit.unknowns.launcher))
    model.trained = Trained(
        position_scale=float(np.sqrt((fit.noise.position**2).mean())),
        launcher=learned.requires_grad_(False) if unlabelled else None,
        spin_noise=max(fit.noise.spin, LEAST_SPIN_SIGMA) if unlabelled else fit.noise.label,
    )
    return model


def values_of(fit: Fit, names: Iterable[str], declared: Mapping[str, float]) -> dict[str, Value]:
    """Fitted coefficients with their standard deviations, by parameter name.

    Args: names: those wanted.  declared: values that the model stated before the fit, for those that it did.
    """
    total = fit.linearised().eliminated().gram.sum(axis=0)[:-1, :-1] + np.diag(fit.problem.common_precision)
    sigmas = dict(zip(fit.problem.free, np.sqrt(np.diagonal(np.linalg.inv(total))).tolist(), strict=False))
    units = fit.problem.model.declared_coefficients()
    return {
        name: Value(fit.unknowns.values[name], sigmas[name], units[name].unit, declared.get(name)) for name in names
    }
