"""Foretells the gain in evidence of every candidate from one linearisation, to choose which ones are refitted."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from ballfg.arrays import Array, Index
from ballfg.diagnosis.evidence.likelihood import Likelihood, Reduced, posterior
from ballfg.diagnosis.evidence.prior import WIDTHS, choice_odds, scales
from ballfg.diagnosis.evidence.rows import Motion, roots, rows_of
from ballfg.diagnosis.evidence.weighed import Priors, Weighed
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis


def foretold(model: Weighed, motion: Motion, hypotheses: Sequence[Hypothesis], columns: Array) -> list[float]:
    """Logarithm of the evidence with each hypothesis over that of the model, at the model's noise.

    Args: motion: random columns of the model's fit.  columns: (n, m, p) of all strengths, as in the fit's system.
    """
    rows, priors = rows_of(model.fit, motion), Priors.of(model.fit, model.named)
    wide = replace(rows, by_common=np.concatenate((rows.by_common, columns / roots(model.fit)), axis=-1))
    reduced, _ = Likelihood(wide, *model.weights).reduced(model.noise)
    own = np.arange(rows.by_common.shape[-1])
    precision = priors.precision(model.widths)
    alone = posterior(_part(reduced, own), precision, priors.away).evidence
    gains, end = [], len(own)
    for hypothesis in hypotheses:
        size = scales(hypothesis)
        part = _part(reduced, np.append(own, np.arange(end, end + len(size))))
        end += len(size)
        away = np.append(priors.away, np.zeros(len(size)))
        found = [posterior(part, np.append(precision, (w * size) ** -2), away).evidence for w in WIDTHS]
        gains.append(float(special.logsumexp(found) - np.log(len(WIDTHS))) - alone + choice_odds([hypothesis]))
    return gains


def _part(reduced: Reduced, chosen: Index) -> Reduced:
    """All tracks with some of the common columns."""
    gram, listed = reduced.gram.sum(axis=0), np.append(chosen, reduced.gram.shape[-1] - 1)
    return Reduced(reduced.constant.sum(keepdims=True), gram[np.ix_(listed, listed)][None])
