"""Synthetic tracks: a launcher, motion with effects that nobody declares, noisy measurements, truth beside them."""

from ballfg.simulate.balls import BallKind, ball_from_mapping, ball_kind, table_tennis, tennis, with_model
from ballfg.simulate.config import MeasurementNoise, ProcessNoise, SimulationConfig
from ballfg.simulate.launcher import Launcher
from ballfg.simulate.measure import SimulatedTrack
from ballfg.simulate.settings import SETTING_LEVELS, all_settings, parse_settings
from ballfg.simulate.synthetic import dataset_info, simulate
from ballfg.simulate.undeclared import UNDECLARED, parse_effects
from ballfg.simulate.writing import write_simulation

__all__ = [
    "SETTING_LEVELS",
    "UNDECLARED",
    "BallKind",
    "Launcher",
    "MeasurementNoise",
    "ProcessNoise",
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
