"""Rows of a fit, with columns for the motion that its model cannot explain.

A fit is deterministic: whatever the model lacks is in its residual. Here the same linearised rows get random columns
beside the first states: white acceleration in short bins of flight, kicks of velocity and spin after contacts, and
coefficients that scatter from track to track. Their sizes are the noise of the model.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.response import fitted_path, responses
from ballfg.diagnosis.residual_tests.residuals import ACCELERATION, CONTACT_SPIN, CONTACT_VELOCITY, free_motion
from ballfg.diagnosis.search.hypothesis import Hypothesis
from ballfg.diagnosis.search.signatures import columns_of
from ballfg.state import STATE_DIM

ACCELERATIONS, VELOCITIES, SPINS, COEFFICIENTS = range(4)
"""Kinds of random columns; each kind has one size for all tracks."""
KINDS: Final = 4
SIZES: Final = (ACCELERATION, CONTACT_VELOCITY, CONTACT_SPIN, 1.0)
"""Unit of each size: m/s^2/sqrt(Hz), m/s, rad/s, and prior standard deviations of the coefficients."""


@dataclass(frozen=True)
class Rows:
    """Whitened rows of n stretches without robust weights: three for each of k samples, then three for the spin.

    Attributes:
        residual: (n, m) measured minus predicted.
        by_start: (n, m, 9) derivatives by the first state.
        random: (n, m, r) by the random columns at their unit, zero where a stretch has fewer.
        kinds: (n, r) kind of each random column, -1 for none.
        by_common: (n, m, q) by the unknowns that all stretches share, then by those of hypotheses.
        used: (n, k) samples that there are.
        labelled: (n,) True where the spin rows compare with a label.
        track: (n,) number of the track.
    """

    residual: Array
    by_start: Array
    random: Array
    kinds: Index
    by_common: Array
    used: Array
    labelled: Array
    track: Index


def rows_of(fit: Fit, scattering: Collection[str], hypotheses: Sequence[Hypothesis] = ()) -> Rows:
    """The rows of a fit at its minimum.

    Args: scattering: coefficients that may differ from track to track.  hypotheses: their strengths get common columns.
    """
    system, stretches = fit.linearised(), fit.problem.stretches
    weights = np.concatenate((np.repeat(fit.robust.samples, 3, axis=1), np.repeat(fit.robust.spins[:, None], 3, 1)), 1)
    root = np.sqrt(weights)[..., None]
    common = system.by_common
    if hypotheses:
        common = np.concatenate((common, columns_of(fit, hypotheses)), axis=-1)
    random, kinds = _random(fit, system.by_common, scattering)
    return Rows(
        system.residual / root[..., 0],
        system.by_start / root,
        random / root,
        kinds,
        common / root,
        stretches.used.numpy(),
        stretches.labelled,
        stretches.track,
    )


def _random(fit: Fit, by_common: Array, scattering: Collection[str]) -> tuple[Array, Index]:
    """(n, m, r) random columns with the fit's robust weights, and (n, r) their kinds."""
    own: dict[int, list[tuple[Array, Array]]] = defaultdict(list)
    for arc in responses(fit, fitted_path(fit)):
        for row, piece in zip(arc.rows.tolist(), free_motion(fit, arc), strict=True):
            kinds = np.full(piece.columns.shape[1], ACCELERATIONS)
            if piece.contact is not None:
                kinds[-6:-3], kinds[-3:] = VELOCITIES, SPINS
            own[row].append((piece.columns * piece.sigma, kinds))
    listed = list(fit.problem.free)
    chosen = [listed.index(name) for name in scattering]
    spread, count = np.array([fit.problem.free[name].sigma for name in scattering]), len(chosen)
    width = max(sum(len(k) for _, k in pieces) for pieces in own.values()) + count
    n, m = by_common.shape[:2]
    random, kinds = np.zeros((n, m, width)), np.full((n, width), -1)
    random[..., :count], kinds[:, :count] = by_common[..., chosen] * spread, COEFFICIENTS
    for row, pieces in own.items():
        columns = np.concatenate([c for c, _ in pieces], axis=1)
        random[row, :, count : count + columns.shape[1]] = columns
        kinds[row, count : count + columns.shape[1]] = np.concatenate([k for _, k in pieces])
    return random, kinds
