"""The unknowns of a fit: the model's coefficients, their deviations on tracks, and what tracks have of their own."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.dynamics import AnalyticModel, Coefficient
from ballfg.dynamics.effects.flight import Wind
from ballfg.tracks import Track

LOOSE = 10.0
"""Factor by which a hypothesis' coefficient has a wider prior than its effect declares: the data should decide."""
INEXACT = 0.02
"""Spread of a coefficient that is declared as exact, as a share of its value: a wrong clock or length changes g so."""
OWN_AIR = tuple(f"{Wind.kind}.{Wind.name}.{c.name}" for c in Wind.coefficients)
"""Coefficients of a wind that every track may have of its own."""


@dataclass(frozen=True)
class Unknowns:
    """All unknowns of a fit: first states (n, 9), coefficients by parameter name, and the launcher.

    The launcher is (s, 3) rad/s per unit of each setting: spin about forward, across and up.
    """

    starts: Array
    values: dict[str, float]
    launcher: Array
    own: Mapping[str, Array] = field(default_factory=dict)
    """By parameter name, (n,) what the coefficients of each stretch differ by from those of all."""


@dataclass(frozen=True)
class Deviation:
    """An unknown of a fit: the deviation of a coefficient on some tracks."""

    coefficient: str  # Its parameter name
    weights: Mapping[str, float]  # By name of the track; the coefficient deviates by the unknown times the weight
    by: str  # Of the corresponding `Variation` in a model file
    level: str  # Its key there
    first: str = ""  # The first track, for a place in the recording: its deviation is zero
    line: bool = False  # Of the `Variation`

    def along(self, stretches: Stretches) -> Array:
        """(n,) weights of stretches."""
        return np.array([self.weights.get(name, 0.0) for name in stretches.names])


def spread(coefficient: Coefficient) -> float:
    """Prior standard deviation of a coefficient; a small one if it is declared as exact."""
    return coefficient.sigma if coefficient.sigma > 0.0 else INEXACT * abs(coefficient.default)


def declared_free(model: AnalyticModel) -> dict[str, Coefficient]:
    """Coefficients that a fit of the declared model estimates: those with a prior of nonzero width."""
    return {n: c for n, c in model.declared_coefficients().items() if c.sigma > 0.0 and c.absent is not None}


def declared_deviations(
    model: AnalyticModel, tracks: Iterable[Track]
) -> tuple[dict[str, Coefficient], dict[str, Deviation], dict[str, float]]:
    """Deviations of a model's declared variations between tracks, with their priors and values.

    Each stated value is an unknown of its own, with a prior wide enough for the data to decide.
    """
    tracks, parameters, listed = list(tracks), dict(model.named_parameters()), model.declared_coefficients()
    free, deviations, values = dict[str, Coefficient](), dict[str, Deviation](), dict[str, float]()
    for name, variation in model.variations.items():
        coefficient, base = listed[name], float(parameters[name].detach())
        for level, value in variation.values.items():
            # a track's value is linear in the stated ones, so that a unit of one of them gives its weight
            alone = replace(variation, values={other: float(other == level) for other in variation.values})
            weights = {track.name: alone.value(track) or 0.0 for track in tracks}
            unknown, width = f"{name}[{level}]", coefficient.high - coefficient.low
            free[unknown] = replace(coefficient, sigma=LOOSE * spread(coefficient), low=-width, high=width)
            deviations[unknown] = Deviation(name, weights, variation.by, level, line=variation.line)
            values[unknown] = value - base
    return free, deviations, values


def coefficients_of_all(
    model: AnalyticModel, names: Iterable[str], found: Mapping[str, float | Array]
) -> dict[str, float | Array]:
    """What the coefficients of stretches differ from, of those that the model has."""
    parameters = dict(model.named_parameters())
    return {name: found.get(name, float(parameters[name])) for name in names if name in parameters}
