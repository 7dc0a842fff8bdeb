"""Effects that no model file declares, one file each: for tests of whether an analysis finds what a model lacks."""

from ballfg.simulate.undeclared.base import AirEffect, MeasurementEffect
from ballfg.simulate.undeclared.registry import UNDECLARED, parse_effects

__all__ = ["UNDECLARED", "AirEffect", "MeasurementEffect", "parse_effects"]
