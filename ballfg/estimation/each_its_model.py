"""Estimates each track with its own coefficients, for models whose coefficients differ between tracks."""

from collections.abc import Callable, Sequence

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch
from ballfg.tracks import Track


class EachItsModel(Estimator):
    """An estimator for each set of coefficients, created when the first track with it comes.

    Args:
        make: the estimator of a model that is the same for all tracks.
        model: with `variations`.  surfaces: what the ball may bounce on.  settings: noise and priors.
    """

    name = "each-its-model"
    undoes_measurement = True
    has_graph = True

    def __init__(
        self, make: Callable[[BallModel], Estimator], model: BallModel, surfaces: Surfaces | float, settings: Settings
    ) -> None:
        super().__init__(model, surfaces, settings)
        self._make = make
        self._made: dict[tuple[float | None, ...], Estimator] = {}

    def of(self, track: Track) -> Estimator:
        """The estimator with the coefficients of a track; tracks with equal coefficients share it."""
        track = self.settings.grouped(track)
        values = tuple(variation.value(track) for variation in self.model.variations.values())
        if values not in self._made:
            self._made[values] = self._make(self.model.for_track(track))
        return self._made[values]

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track, one per stamp, with the track's own coefficients."""
        return self.of(self.prepared(track)).estimate(track, factors)
