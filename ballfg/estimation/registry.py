"""Registers the estimators by name: those of the package, of the user, and of other installed packages."""

from functools import partial
from typing import Final

from ballfg.checks import check_instance, shown
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.settings import Settings
from ballfg.registry import Registry

ESTIMATORS: Final[Registry[Estimator]] = Registry(
    "estimator",
    group="ballfg.estimators",
    base=Estimator,
    remedy="docs/estimators.md has an example.",
    own={
        "smoother": "ballfg.estimation.smoother.pieces.long_tracks:PiecewiseSmoother",
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
    check_instance("model", model, BallModel, "Load one with load_model.")
    make = partial(_estimator, ESTIMATORS[name], surfaces, settings)
    if not model.variations:
        return make(model)
    from ballfg.estimation.each_its_model import EachItsModel

    return EachItsModel(make, model, surfaces, settings)


def _estimator(kind: type[Estimator], surfaces: Surfaces | float, settings: Settings, model: BallModel) -> Estimator:
    if not model.measures_plainly:
        from ballfg.estimation.measurement.invert_measurement import InvertMeasurement

        return InvertMeasurement(kind, model, surfaces, settings)
    return kind(model, surfaces, settings)
