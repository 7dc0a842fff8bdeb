"""Beside first states a fit estimates the coefficients that a model declares, and their deviations on some tracks."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.dynamics import AnalyticModel, Coefficient
from ballfg.tracks import Track

LOOSE = 10.0
"""Factor by which the prior of a hypothesis' coefficient is wider than the effect declares: the data are to decide."""
INEXACT = 0.02
"""Spread of a coefficient that is declared as exact, as a share of its value: a wrong clock or length shows so in g."""


@dataclass(frozen=True)
class Deviation:
    """An unknown of a fit by which a coefficient is off on some tracks.

    Attributes:
        coefficient: its parameter name.
        weights: by name of the track; the coefficient is off by the unknown times the weight.
        by, level, line: of the `Variation` that it becomes in a model file, and its key there.
        first: the first track, of a place in the recording: there the coefficient is not off.
    """

    coefficient: str
    weights: Mapping[str, float]
    by: str
    level: str
    first: str = ""
    line: bool = False

    def along(self, stretches: Stretches) -> Array:
        """(n,) weights of stretches."""
        return np.array([self.weights.get(name, 0.0) for name in stretches.names])


def spread(coefficient: Coefficient) -> float:
    """Prior standard deviation of a coefficient, and a small one where it is declared as exact."""
    return coefficient.sigma if coefficient.sigma > 0.0 else INEXACT * abs(coefficient.default)


def declared_free(model: AnalyticModel) -> dict[str, Coefficient]:
    """Coefficients that a fit of the declared model estimates: those whose prior leaves room."""
    return {n: c for n, c in model.declared_coefficients().items() if c.sigma > 0.0 and c.absent is not None}


def declared_deviations(
    model: AnalyticModel, tracks: Iterable[Track]
) -> tuple[dict[str, Coefficient], dict[str, Deviation], dict[str, float]]:
    """Deviations of the coefficients that a model declares to differ between tracks, their priors and their values.

    Each value that the model states is an unknown of its own, as wide as the data want it.
    """
    tracks, parameters, listed = list(tracks), dict(model.named_parameters()), model.declared_coefficients()
    free, deviations, values = dict[str, Coefficient](), dict[str, Deviation](), dict[str, float]()
    for name, variation in model.variations.items():
        coefficient, base = listed[name], float(parameters[name].detach())
        for level, value in variation.values.items():
            # a track's value is linear in those that are stated, so that one of them alone gives its weight
            alone = replace(variation, values={other: float(other == level) for other in variation.values})
            weights = {track.name: alone.value(track) or 0.0 for track in tracks}
            unknown, width = f"{name}[{level}]", coefficient.high - coefficient.low
            free[unknown] = replace(coefficient, sigma=LOOSE * spread(coefficient), low=-width, high=width)
            deviations[unknown] = Deviation(name, weights, variation.by, level, line=variation.line)
            values[unknown] = value - base
    return free, deviations, values
