"""The estimators by name: those of the package, of the user, and of other installed packages."""

from functools import partial
from typing import Final

from ballfg.checks import check_instance, shown
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.each_its_model import EachItsModel
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.online.online import Online
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.registry import Registry

ESTIMATORS: Final[Registry[Estimator]] = Registry(
    "estimator", group="ballfg.estimators", base=Estimator, remedy="docs/estimators.md has an example."
)
register_estimator = ESTIMATORS.register
"""Lets an estimator be named by commands and benchmarks; may decorate the class."""
for _own in (Smoother, Online, ExtendedKalmanFilter, SlidingWindow):
    register_estimator(_own)


def make_estimator(name: str, model: BallModel, surfaces: Surfaces | float, settings: Settings) -> Estimator:
    """The estimator of a name.

    It undoes the model's measurement effects, where there are any, and gives each track its own coefficients, where the
    model says that they differ between tracks.

    Args:
        name: of a registered estimator.
        model, surfaces, settings: as for every `Estimator`.
    Raises: ValueError: if there is none of that name; the message lists those there are.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"method must be one of {', '.join(ESTIMATORS)}; got {shown(name)}")
    check_instance("model", model, BallModel, "Load one with load_model.")
    make = partial(_estimator, ESTIMATORS[name], surfaces, settings)
    return EachItsModel(make, model, surfaces, settings) if model.variations else make(model)


def _estimator(kind: type[Estimator], surfaces: Surfaces | float, settings: Settings, model: BallModel) -> Estimator:
    if not model.measures_plainly:
        return InvertMeasurement(kind, model, surfaces, settings)
    return kind(model, surfaces, settings)
