"""Computes signatures: the change of the samples by each absent coefficient, with states projected out.

Tests of candidate effects need only the inner products of these columns, track by track.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.free import Deviation
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.sensitivity import sensitivity
from ballfg.diagnosis.fit.system import System, by_track
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis

LEAST_SHARE = 1e-8
"""Least share of a column's length that survives projection: less is rounding, and the effect is invisible."""


@dataclass(frozen=True)
class Signatures:
    """Inner products (t, q + p + 1, q + p + 1) of projected columns, summed over each of t tracks.

    There are q = `common` columns, whose priors have the precision (q,), p columns of candidates, and the residual.
    """

    gram: Array
    precision: Array
    common: int

    @property
    def tracks(self) -> int:
        """Number of tracks."""
        return len(self.gram)

    def efficient(self) -> "Efficient":
        """Scores and information of the candidates, with the common columns projected out too."""
        q, g = self.common, self.gram
        total = g.sum(axis=0)
        share = np.linalg.solve(total[:q, :q] + np.diag(self.precision), total[:q, q:-1])
        cross = g[:, q:-1, :q] @ share
        information = g[:, q:-1, q:-1] - cross - cross.swapaxes(-1, -2) + share.T @ g[:, :q, :q] @ share
        prior = share.T @ (self.precision[:, None] * share)
        score = g[:, q:-1, -1] - g[:, :q, -1] @ share
        return Efficient(score, np.asarray(information), np.asarray(prior), np.diagonal(total)[q:-1])


@dataclass(frozen=True)
class Efficient:
    """Scores (t, p) of p columns on t tracks, with their information (t, p, p)."""

    score: Array
    information: Array
    prior: Array  # (p, p) remaining information of the common columns' priors
    raw: Array  # (p,) squared length of each column before common columns were projected out

    @property
    def total(self) -> Array:
        """(p, p) information over all tracks."""
        return np.asarray(self.information.sum(axis=0) + self.prior)


def visible_directions(information: Array, raw: Array) -> Array:
    """(p, r) the remaining directions of p coefficients after projection; r is zero without any.

    Args: information: (p, p), all else projected out.  raw: (p,) of each if all else were known.
    """
    if not (raw > 0.0).any():
        return np.zeros((len(raw), 0))
    length = np.sqrt(np.maximum(raw, LEAST_SHARE * raw.max()))
    value, vector = np.linalg.eigh(information / np.outer(length, length))
    return np.asarray(vector[:, value > LEAST_SHARE] / length[:, None])


def signatures_of(fit: Fit, system: System, columns: Array) -> Signatures:
    """Inner products of the common columns of a fit and of further columns (n, m, p); system: the fit's, linearised."""
    whole = replace(system, by_common=np.concatenate((system.by_common, columns), axis=-1))
    gram = by_track(whole.eliminated().gram, fit.problem.stretches.track)
    return Signatures(gram, fit.problem.common_precision, system.by_common.shape[-1])


def hypothesis_signatures(
    fit: Fit, candidates: Sequence[Hypothesis], columns: Array | None = None
) -> tuple[Signatures, list[list[int]]]:
    """Inner products of all columns on each track, and the numbers of the candidate columns of each hypothesis.

    Args: columns: `columns_of(fit, candidates)`, if they are known.
    """
    ends = np.cumsum([len(hypothesis.strengths) for hypothesis in candidates]).tolist()
    chosen = [list(range(end - len(h.strengths), end)) for end, h in zip(ends, candidates, strict=True)]
    return signatures_of(fit, fit.linearised, columns_of(fit, candidates) if columns is None else columns), chosen


def columns_of(fit: Fit, candidates: Sequence[Hypothesis]) -> Array:
    """(n, m, p) columns of all candidates, in their order; none without candidates.

    Measurement effects are computed by themselves: their further states are costly.
    """
    none, parts = np.zeros((*fit.weighted_residual(fit.robust).shape, 0)), dict[int, Array]()
    for late in (False, True):
        group = [i for i, h in enumerate(candidates) if (h.effect.kind == "measurement") is late]
        if group:
            ends = np.cumsum([len(candidates[i].strengths) for i in group])[:-1]
            own = np.split(hypothesis_columns(fit, [candidates[i] for i in group]), ends, axis=-1)
            parts |= dict(zip(group, own, strict=True))
    return np.concatenate([none, *(parts[i] for i in range(len(candidates)))], axis=-1)


def hypothesis_columns(fit: Fit, group: Sequence[Hypothesis]) -> Array:
    """(n, m, p) whitened, weighted derivatives of the samples by the strengths of hypotheses.

    One model holds all of them at zero strength, so that none affects another. A deviation needs no derivative of its
    own: it is that of its coefficient, times a weight.
    """
    model = fit.model
    for hypothesis in group:
        model = hypothesis.added_to(model)
    asked = [_asked(h) for h in group]
    wanted = list(dict.fromkeys(key for own in asked for key, _ in own))
    parameters, shapes = dict(model.named_parameters()), [dict(shape) for _, shape in wanted]
    names = [name for name, _ in wanted]
    values = {name: float(parameters[name]) for name in [*names, *(n for shape in shapes for n in shape)]}
    stretches, starts = fit.problem.stretches, fit.unknowns.starts
    known = {**values, **fit.values}
    derivative = sensitivity(model, stretches, starts, known, names, by_start=False, shapes=shapes)
    scale = np.sqrt(fit.robust.spins) * stretches.labelled / fit.noise.label
    labels = derivative.labels * scale[:, None, None]
    columns = np.concatenate((fit.position_rows(derivative.positions), labels), axis=1)
    chosen = [wanted.index(key) for own in asked for key, _ in own]
    found = columns[..., chosen]
    for place, deviation in enumerate(d for own in asked for _, d in own):
        if deviation is not None:
            found[..., place] *= deviation.along(stretches)[:, None]
    return found


_Key = tuple[str, tuple[tuple[str, float], ...]]
"""A coefficient by parameter name, with the values of others for its derivative."""


def _asked(hypothesis: Hypothesis) -> list[tuple[_Key, Deviation | None]]:
    """The derivative behind each strength of a hypothesis, and the deviation that weights it."""
    shape = tuple((hypothesis.parameter(name), value) for name, value in hypothesis.shape.items())
    deviations = hypothesis.deviations()
    found = [(deviations.get(name), name) for name in hypothesis.columns]
    return [((name if own is None else own.coefficient, shape), own) for own, name in found]
