"""An estimate whose states beside contacts are those of the more probable side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ballfg.estimation.result import Estimate
from ballfg.estimation.sides.watch import Told
from ballfg.factors.linear.definite import compatible
from ballfg.state import STATE_DIM


def on_both_sides(estimate: Estimate, told: Mapping[int, Told]) -> Estimate:
    """The estimate with other states at some samples; its coefficients stay as they are known with all states.

    Args: estimate: of a track.  told: what is to be told of the ball, by sample.
    """
    others = estimate.other_sides
    others = others.copy() if len(others) else np.zeros_like(estimate.covariances)
    if not told or estimate.status.failed:
        return replace(estimate, other_sides=others)
    state, shared = slice(STATE_DIM), slice(STATE_DIM, STATE_DIM + len(estimate.coefficients))
    states, covariances, cross = (
        array.copy() for array in (estimate.states, estimate.covariances, estimate.cross_covariances)
    )
    for k, one in told.items():
        states[k], others[k] = one.mean[state], one.other
        own = one.covariance[state, state]
        with_shared = one.covariance[None, state, shared]
        cross[k] = compatible(with_shared, own[None], estimate.coefficient_covariance)[0]
        covariances[k] = one.widened[state, state]
    return replace(estimate, states=states, covariances=covariances, other_sides=others, cross_covariances=cross)
