"""The one interface of all estimators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.tracks import Track


class Estimator(ABC):
    """Turns a track into states.

    Args:
        model: the ball.
        surfaces: what it may bounce on.
        settings: noise and priors.

    Raises: ValueError: if the model has measurement effects and the estimator does not undo them.
    """

    name: ClassVar[str]
    undoes_measurement: ClassVar[bool] = False
    """Whether it takes a model that does not measure plainly."""

    def __init__(self, model: BallModel, surfaces: Surfaces, settings: Settings) -> None:
        if not (model.measures_plainly or self.undoes_measurement):
            raise ValueError(
                f"model must have no measurement effects for the estimator '{self.name}' by itself. "
                "Use make_estimator, which undoes them, or leave the model's section measurement empty."
            )
        self.model = model
        self.surfaces = surfaces
        self.settings = settings

    @abstractmethod
    def estimate(self, track: Track) -> Estimate:
        """The states of a track, one per stamp.

        Never raises for what the data hold: a track too short or too wild gives a status that says so.
        """
