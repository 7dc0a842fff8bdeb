"""Registers the estimators by name: those of the package, of the user, and of other installed packages."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from ballfg.checks import shown
from ballfg.dynamics.compiled.kept_model import check_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch
from ballfg.registry import Registry
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


class EachItsModel(Estimator):
    """An estimator for each set of coefficients that differ between tracks, made for the first track with it."""

    name = "each-its-model"
    undoes_measurement = True
    has_graph = True

    def __init__(
        self, make: Callable[[BallModel], Estimator], model: BallModel, surfaces: Surfaces | float, settings: Settings
    ) -> None:
        super().__init__(model, surfaces, replace(settings, group=None))  # a track's own label comes first
        self.settings = replace(self.settings, group=settings.group)
        self._make = make
        self._made: dict[tuple[float | None, ...], Estimator] = {}

    def of(self, track: Track) -> Estimator:
        """The estimator with the coefficients of a track; tracks with equal coefficients share it."""
        track = self.settings.grouped(track)
        values = tuple(variation.value(track) for variation in self.model.variations.values())
        if values not in self._made:
            own = copy.copy(self.model.for_track(track))
            own.variations = {}  # one ball, whatever the settings' group
            self._made[values] = self._make(own)
        return self._made[values]

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track, one per stamp, with the track's own coefficients."""
        return self.of(self.prepared(track)).estimate(track, factors)


ESTIMATORS: Final[Registry[Estimator]] = Registry(
    "estimator",
    group="ballfg.estimators",
    base=Estimator,
    remedy="docs/estimators.md has an example.",
    own={
        "smoother": "ballfg.estimation.smoother.smoother:PiecewiseSmoother",
        "online": "ballfg.estimation.online.online:Online",
        "ekf": "ballfg.estimation.filters.ekf:ExtendedKalmanFilter",
        "sliding-window": "ballfg.estimation.filters.sliding_window:SlidingWindow",
    },
)
register_estimator = ESTIMATORS.register
"""Registers an estimator, so that commands and benchmarks know its name; may decorate the class."""


def make_estimator(name: str, model: BallModel, surfaces: Surfaces | float, settings: Settings) -> Estimator:
    """The estimator with a name.

    It undoes the model's measurement effects, if any, and gives each track its own coefficients, if they differ between
    tracks.

    Args: name: of a registered estimator.  model, surfaces, settings: as for every `Estimator`.
    Raises: ValueError: if there is none of that name; the message lists those there are.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"method must be one of {', '.join(ESTIMATORS)}; got {shown(name)}. Choose one.")
    check_model(model, "Load one with load_model.")
    make = partial(_estimator, ESTIMATORS[name], surfaces, settings)
    if not model.variations:
        return make(model)
    return EachItsModel(make, model, surfaces, settings)


def _estimator(kind: type[Estimator], surfaces: Surfaces | float, settings: Settings, model: BallModel) -> Estimator:
    if not model.measures_plainly:
        from ballfg.estimation.measurement.invert_measurement import InvertMeasurement

        return InvertMeasurement(kind, model, surfaces, settings)
    return kind(model, surfaces, settings)
