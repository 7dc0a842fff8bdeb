"""Signatures of hypotheses: what each absent coefficient would do to the samples, with states projected out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnosis.fit.problem import Fit, common_precision, linearise
from ballfg.diagnosis.fit.sensitivity import Sensitivity, sensitivity
from ballfg.diagnosis.fit.system import System, by_track
from ballfg.diagnosis.search.hypothesis import Hypothesis
from ballfg.diagnosis.search.signatures import Signatures
from ballfg.dynamics.analytic import AnalyticModel

Array = NDArray[np.float64]


def signatures(fit: Fit, candidates: Sequence[Hypothesis]) -> tuple[Signatures, list[list[int]]]:
    """Inner products of all columns on each track, and which candidate columns belong to each hypothesis.

    Args:
        fit: of the declared model, an `AnalyticModel`.
        candidates: hypotheses that it may lack.
    """
    base = linearise(fit.problem, fit.unknowns, fit.noise, fit.predicted)
    chosen, count = [], 0
    for hypothesis in candidates:
        chosen.append(list(range(count, count + len(hypothesis.strengths))))
        count += len(hypothesis.strengths)
    common = base.by_common.shape[-1]
    columns = np.concatenate((base.by_common, _columns(fit, candidates)), axis=-1)
    system = System(base.residual, base.by_start, columns)
    gram = by_track(system.eliminated().gram, fit.problem.stretches.track)
    return Signatures(gram, common_precision(fit.problem), common), chosen


def hypothesis_columns(fit: Fit, hypothesis: Hypothesis) -> Array:
    """(n, m, p) whitened, weighted derivative of what is measured by the strengths of a hypothesis."""
    return _together(fit, [hypothesis])


def _columns(fit: Fit, candidates: Sequence[Hypothesis]) -> Array:
    """Columns of all candidates, in their order.

    Those that act on the ball are taken together, and so are those that act on its measurement: the latter call for
    states at further moments, which is dear where rows are many.
    """
    groups = [
        [i for i, h in enumerate(candidates) if (h.effect.kind == "measurement") is late] for late in (False, True)
    ]
    parts: dict[int, Array] = {}
    for group in groups:
        ends = np.cumsum([len(candidates[i].strengths) for i in group])[:-1]
        own = np.split(_together(fit, [candidates[i] for i in group]), ends, axis=-1) if group else []
        parts |= dict(zip(group, own, strict=True))
    return np.concatenate([parts[i] for i in range(len(candidates))], axis=-1)


def _together(fit: Fit, group: Sequence[Hypothesis]) -> Array:
    """Columns of hypotheses from one model that holds all of them: each is absent, so that none sees another."""
    model = fit.problem.model
    assert isinstance(model, AnalyticModel)
    for hypothesis in group:
        model = hypothesis.added_to(model)
    own = [{h.parameter(n): v for n, v in h.shape.items()} for h in group]
    names = [name for h in group for name in h.columns]
    parameters = dict(model.named_parameters())
    shared = {name: float(parameters[name]) for name in [*names, *(n for shape in own for n in shape)]}
    derivative = sensitivity(
        model,
        fit.problem.stretches,
        fit.unknowns.starts,
        {**shared, **fit.unknowns.values},
        names,
        by_start=False,
        shapes=[shape for h, shape in zip(group, own, strict=True) for _ in h.strengths],
    )
    return _weighted(fit, derivative)


def _weighted(fit: Fit, derivative: Sensitivity) -> Array:
    """Rows as in `fit.assemble`."""
    weights, labelled = fit.robust, fit.problem.stretches.labelled
    n, k = weights.samples.shape
    rows = derivative.positions * (np.sqrt(weights.samples)[..., None] / fit.sigmas)[..., None]
    labels = derivative.labels * (np.sqrt(weights.spins) * labelled / fit.noise.label)[:, None, None]
    return np.asarray(np.concatenate((rows.reshape(n, 3 * k, -1), labels), axis=1))
