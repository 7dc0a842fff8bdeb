from .configure import dataset_settings as dataset_settings, dataset_surfaces as dataset_surfaces
from .conformal import ConformalScales as ConformalScales
from .estimator import Estimator as Estimator
from .filters.ekf import ExtendedKalmanFilter as ExtendedKalmanFilter
from .filters.sliding_window import SlidingWindow as SlidingWindow
from .noise.estimate import estimate_noise as estimate_noise
from .observations.observation import Observation as Observation, Unknowns as Unknowns
from .observations.reading import RadarSpeed as RadarSpeed, Reading as Reading, SpinReading as SpinReading
from .observations.registry import register_observation as register_observation
from .observations.sighted_dataset import read_sighted as read_sighted
from .observations.sightings import CameraSightings as CameraSightings, sighted_track as sighted_track
from .online.online import Online as Online
from .reading import read as read
from .registry import register_estimator as register_estimator
from .result import Estimate as Estimate, Status as Status
from .settings import Settings as Settings
from .smoother.problem import TrackProblem as TrackProblem
from .smoother.smoother import Smoother as Smoother
from .smoother.time_offsets import estimate_time_offsets as estimate_time_offsets
from .smoother.track_graph import TrackGraph as TrackGraph
from .track_prediction import predict_tracks as predict_tracks
