from .analytic import AnalyticModel as AnalyticModel
from .effect import (
    BounceEffect as BounceEffect,
    Coefficient as Coefficient,
    Flight as Flight,
    FlightEffect as FlightEffect,
    Impact as Impact,
    Range as Range,
    Scene as Scene,
    Usual as Usual,
    length as length,
    vector as vector,
)
from .effects.registry import EFFECTS as EFFECTS, load_effects as load_effects, register as register
from .measurement import MeasurementEffect as MeasurementEffect
from .model import BallModel as BallModel
from .model_file import load_model as load_model, save_model as save_model
from .motion.rollout import rollout as rollout
from .networks.architecture import Architecture as Architecture
from .networks.learned import build as build
from .nominal import nominal_model as nominal_model
from .surfaces import Surfaces as Surfaces
