"""A test for spin labels that contradict their flights.

A label is compared with the spin that the flight alone shows. The squared distance over both uncertainties is a
chi-square with three degrees of freedom. Noise that is stated too small raises the distances of all tracks, which a
common scale corrects. A label that stands out among the others belongs to another shot, or was measured wrongly. Where
most labels are off by several times their noise, no misjudged noise explains that: labels and model disagree.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import System
from ballfg.state import SPIN, STATE_DIM

LABEL = "label"
"""Kind of the test."""
LEAST_LABELS = 6
"""With fewer labels none can be said to stand out."""
OPEN_SPIN = 2000.0
"""rad/s. Prior of each component of a spin that the flight does not show: twice the fastest strokes."""
STANDS_OUT = 0.005
"""Probability, corrected for the number of labels, below which a label is counted as contradicted."""
FAR = 9.0
"""Square of the distance, in multiples of its noise, beyond which a label counts where most are off: three times."""
MISJUDGED = 1.3**2
"""Square of the factor by which a stated noise may be wrong without anything else being wrong."""


@dataclass(frozen=True)
class LabelCheck:
    """The test.

    Attributes:
        p_value: of the label that stands out most, corrected for the number of labels; or of so many far labels.
        contradicted: tracks whose labels stand out or, where most labels are far off, all far ones; the worst first.
        labels: how many there are.
        typical: rad/s, median distance of a contradicted label from the spin that the flight shows.
    """

    p_value: float
    contradicted: tuple[str, ...]
    labels: int
    typical: float

    @property
    def where(self) -> str:
        """In words, which labels contradict their flights."""
        if not self.contradicted:
            return f"label: none of {self.labels} spin labels contradicts its flight"
        shown = ", ".join(self.contradicted[:4]) + (", ..." if len(self.contradicted) > 4 else "")
        return (
            f"label: {len(self.contradicted)} of {self.labels} spin labels contradict their flights, "
            f"typically by {self.typical:.0f} rad/s (tracks {shown})"
        )


def check_labels(fit: Fit, system: System) -> LabelCheck | None:
    """The test of a fit; None where there are too few labels; system: of the fit, linearised at its minimum."""
    rows = np.flatnonzero(fit.problem.stretches.labelled)
    if len(rows) < LEAST_LABELS:
        return None
    distance, off = _distances(fit, system, rows)
    usual = stats.chi2.median(3)
    scale = max(1.0, float(np.median(distance)) / usual)
    # the scale is itself estimated: F in place of chi-square
    alone = len(rows) * stats.f.sf(distance / (3.0 * scale), 3, len(rows) - 1)
    far = distance > FAR * usual
    most = float(stats.binom.sf(far.sum() - 1, len(rows), stats.chi2.sf(FAR * usual / MISJUDGED, 3)))
    out = np.flatnonzero(far if scale > FAR else alone < STANDS_OUT)
    out = out[np.argsort(-distance[out], kind="stable")]
    return LabelCheck(
        p_value=min(1.0, float(alone.min()), most if scale > FAR else 1.0),
        contradicted=tuple(fit.problem.stretches.names[rows[i]] for i in out),
        labels=len(rows),
        typical=float(np.median(off[out])) if len(out) else float("nan"),
    )


def _distances(fit: Fit, system: System, rows: Index) -> tuple[Array, Array]:
    """Squared distance (m,) of each label from the spin that its flight shows, over their noise; and in rad/s."""
    labels = system.by_start[rows, -3:] / np.sqrt(fit.robust.spins[rows])[:, None, None]
    flight, residual = system.by_start[rows, :-3], system.residual[rows, :-3]
    information = flight.swapaxes(-1, -2) @ flight
    spin = np.arange(STATE_DIM)[SPIN]
    information[:, spin, spin] += OPEN_SPIN**-2
    pulled = np.concatenate((flight.swapaxes(-1, -2) @ residual[..., None], labels.swapaxes(-1, -2)), axis=-1)
    solved = np.linalg.solve(information, pulled)
    left = fit.whitened_spins[rows] - (labels @ solved[..., :1])[..., 0]
    covariance = np.eye(3) + labels @ solved[..., 1:]
    distance = (left * np.linalg.solve(covariance, left[..., None])[..., 0]).sum(axis=-1)
    return distance, fit.noise.label * np.linalg.norm(left, axis=-1)
