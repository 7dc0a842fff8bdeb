"""Finds what tracks have of their own: what their coefficients and the air differ by from those of all tracks."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.likelihood import Batches, Noise
from ballfg.diagnosis.evidence.rows import Motion
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.state import STATE_DIM


def most_probable(fit: Fit, likelihood: Batches, noise: Noise, motion: Motion, step: Array) -> dict[str, Array]:
    """By parameter name, (n,) what the coefficients of each stretch most probably differ by, within their bounds.

    Args: likelihood: of the rows of the fit.  motion: with which they were made.  step: (c,) of the common unknowns.
    """
    found = np.zeros((len(fit.unknowns.starts), len(motion.spread)))
    for part in likelihood.parts:
        common = np.zeros(part.rows.by_common.shape[-1])
        common[: len(step)] = step  # patterns stay
        local = part.local_step(noise, common)[:, STATE_DIM:]
        found[part.rows.numbers] = local[:, : found.shape[1]]
    return fit.within({name: u * own for (name, u), own in zip(motion.spread.items(), found.T, strict=True)})


def carried_over(
    fit: Fit, named: Sequence[Hypothesis], other: Fit, other_named: Sequence[Hypothesis]
) -> dict[str, Array]:
    """What stretches of a fit have of their own, for another one with other effects: those change what all have.

    The sum of both stays, so that the paths do.
    """
    own = dict(fit.unknowns.own)
    before, after = (one.problem.by_stretch(one.unknowns.values) for one in (fit, other))
    others = [h for h in (*named, *other_named) if (h in named) is not (h in other_named)]
    moved = {name for h in others for name in (*h.columns, *(d.coefficient for d in h.deviations().values()))}
    for name in own.keys() & moved:
        own[name] = own[name] + before.get(name, 0.0) - after.get(name, 0.0)
    return own
