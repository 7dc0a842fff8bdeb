"""Estimators: one a file, one interface, one result type."""

from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.launcher import Launcher
from ballfg.estimation.observations.files import write_readings
from ballfg.estimation.observations.observation import Context, Observation
from ballfg.estimation.observations.reading import RadarSpeed, Reading, SpinReading
from ballfg.estimation.observations.registry import OBSERVATIONS, register_observation
from ballfg.estimation.observations.sighted_dataset import SightedDataset, read_sighted
from ballfg.estimation.observations.sightings import CameraSightings, in_order, sighted_track
from ballfg.estimation.online.online import Online
from ballfg.estimation.reading import read
from ballfg.estimation.registry import ESTIMATORS, make_estimator, register_estimator
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.estimation.smoother.time_offsets import TimeOffsets, estimate_time_offsets
from ballfg.estimation.track_prediction import TrackPrediction, check_observe, predict_tracks

__all__ = [
    "ESTIMATORS",
    "OBSERVATIONS",
    "CameraSightings",
    "Context",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "Launcher",
    "Observation",
    "Online",
    "RadarSpeed",
    "Reading",
    "Settings",
    "SightedDataset",
    "SlidingWindow",
    "Smoother",
    "SpinReading",
    "Status",
    "TimeOffsets",
    "TrackPrediction",
    "TrackProblem",
    "check_observe",
    "dataset_settings",
    "dataset_surfaces",
    "estimate_time_offsets",
    "estimate_tracks",
    "in_order",
    "make_estimator",
    "predict_tracks",
    "read",
    "read_sighted",
    "register_estimator",
    "register_observation",
    "sighted_track",
    "write_readings",
]
