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
from ballfg.estimate.sighted import SightedTrack, in_order, sighted_track
from ballfg.estimate.sighted_dataset import SightedDataset, read_sighted
from ballfg.estimate.sliding_window import SlidingWindow
from ballfg.estimate.smoother import Smoother
from ballfg.estimate.time_offsets import TimeOffsets, estimate_time_offsets

__all__ = [
    "ESTIMATORS",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "Launcher",
    "Online",
    "Settings",
    "SightedDataset",
    "SightedTrack",
    "SlidingWindow",
    "Smoother",
    "Status",
    "TimeOffsets",
    "dataset_settings",
    "dataset_surfaces",
    "estimate_time_offsets",
    "estimate_tracks",
    "in_order",
    "make_estimator",
    "read_sighted",
    "sighted_track",
    "uncertain",
]
