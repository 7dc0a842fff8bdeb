"""Signatures of hypotheses: what each absent coefficient would do to the samples, with states projected out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnose.hypothesis import Hypothesis
from ballfg.diagnose.problem import Fit, common_precision, linearise
from ballfg.diagnose.sensitivity import Sensitivity, sensitivity
from ballfg.diagnose.signatures import Signatures
from ballfg.diagnose.system import System, by_track
from ballfg.dynamics.analytic import AnalyticModel

Array = NDArray[np.float64]


def signatures(fit: Fit, candidates: Sequence[Hypothesis]) -> tuple[Signatures, list[list[int]]]:
    """Inner products of all columns on each track, and which candidate columns belong to each hypothesis.

    Args:
        fit: of the declared model, an `AnalyticModel`.
        candidates: hypotheses that it may lack.
    """
    base = linearise(fit.problem, fit.unknowns, fit.noise, fit.predicted)
    parts, chosen, count = [], [], 0
    for hypothesis in candidates:
        parts.append(hypothesis_columns(fit, hypothesis))
        chosen.append(list(range(count, count + len(hypothesis.strengths))))
        count += len(hypothesis.strengths)
    common = base.by_common.shape[-1]
    system = System(base.residual, base.by_start, np.concatenate((base.by_common, *parts), axis=-1))
    gram = by_track(system.eliminated().gram, fit.problem.stretches.track)
    return Signatures(gram, common_precision(fit.problem), common), chosen


def hypothesis_columns(fit: Fit, hypothesis: Hypothesis) -> Array:
    """(n, m, p) whitened, weighted derivative of what is measured by the strengths of a hypothesis."""
    model = fit.problem.model
    assert isinstance(model, AnalyticModel)
    names = hypothesis.columns
    absent = dict(zip(names, _absent(hypothesis, model), strict=True))
    derivative = sensitivity(
        hypothesis.added_to(model),
        fit.problem.stretches,
        fit.unknowns.starts,
        {**fit.unknowns.values, **absent},
        names,
        by_start=False,
    )
    return _weighted(fit, derivative)


def _absent(hypothesis: Hypothesis, model: AnalyticModel) -> list[float]:
    parameters = dict(hypothesis.added_to(model).named_parameters())
    return [float(parameters[name]) for name in hypothesis.columns]


def _weighted(fit: Fit, derivative: Sensitivity) -> Array:
    """Rows as in `fit.assemble`."""
    weights, labelled = fit.robust, fit.problem.stretches.labelled
    n, k = weights.samples.shape
    rows = derivative.positions * (np.sqrt(weights.samples)[..., None] / fit.sigmas)[..., None]
    labels = derivative.labels * (np.sqrt(weights.spins) * labelled / fit.noise.label)[:, None, None]
    return np.asarray(np.concatenate((rows.reshape(n, 3 * k, -1), labels), axis=1))
