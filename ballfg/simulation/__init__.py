"""Synthetic tracks: a launcher, motion with effects that nobody declares, noisy measurements, truth beside them."""

from ballfg.simulation.balls import BallKind, ball_from_mapping, ball_kind, table_tennis, tennis, with_model
from ballfg.simulation.config import MeasurementNoise, MotionNoise, SimulationConfig
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.simulation.measure import SimulatedTrack
from ballfg.simulation.settings import SETTING_LEVELS, all_settings, parse_settings
from ballfg.simulation.synthetic import dataset_info, simulate
from ballfg.simulation.undeclared import UNDECLARED, parse_effects
from ballfg.simulation.writing import write_simulation

__all__ = [
    "SETTING_LEVELS",
    "UNDECLARED",
    "BallKind",
    "MeasurementNoise",
    "MotionNoise",
    "SimulatedLauncher",
    "SimulatedTrack",
    "SimulationConfig",
    "all_settings",
    "ball_from_mapping",
    "ball_kind",
    "dataset_info",
    "parse_effects",
    "parse_settings",
    "simulate",
    "table_tennis",
    "tennis",
    "with_model",
    "write_simulation",
]
