"""Estimators: one a file, one interface, one result type."""

from ballfg.estimate.batch import estimate_tracks
from ballfg.estimate.configure import dataset_settings, dataset_surfaces
from ballfg.estimate.ekf import ExtendedKalmanFilter
from ballfg.estimate.estimator import Estimator
from ballfg.estimate.launcher import Launcher
from ballfg.estimate.online import Online
from ballfg.estimate.registry import ESTIMATORS, make_estimator
from ballfg.estimate.result import Estimate, Status
from ballfg.estimate.settings import Settings, uncertain
from ballfg.estimate.sliding_window import SlidingWindow
from ballfg.estimate.smoother import Smoother

__all__ = [
    "ESTIMATORS",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "Launcher",
    "Online",
    "Settings",
    "SlidingWindow",
    "Smoother",
    "Status",
    "dataset_settings",
    "dataset_surfaces",
    "estimate_tracks",
    "make_estimator",
    "uncertain",
]
