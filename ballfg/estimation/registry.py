"""The estimators by name."""

from __future__ import annotations

from typing import Final

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.measurement.invert_measurement import ThroughMeasurement
from ballfg.estimation.online.online import Online
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother

ESTIMATORS: Final[dict[str, type[Estimator]]] = {
    estimator.name: estimator for estimator in (Smoother, Online, ExtendedKalmanFilter, SlidingWindow)
}


def make_estimator(name: str, model: BallModel, surfaces: Surfaces, settings: Settings) -> Estimator:
    """The estimator of a name; one that undoes the model's measurement effects, where there are any.

    Raises: ValueError: if there is none of that name; the message lists those there are.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"method must be one of {', '.join(ESTIMATORS)}; got '{name}'")
    if not model.measures_plainly:
        return ThroughMeasurement(ESTIMATORS[name], model, surfaces, settings)
    return ESTIMATORS[name](model, surfaces, settings)
