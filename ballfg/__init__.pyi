from . import (
    benchmarks as benchmarks,
    diagnosis as diagnosis,
    dynamics as dynamics,
    estimation as estimation,
    factors as factors,
    importing as importing,
    learning as learning,
    live as live,
    prediction as prediction,
    simulation as simulation,
    tracks as tracks,
    vision as vision,
)
from .diagnosis import Diagnosis as Diagnosis
from .dynamics import (
    AnalyticModel as AnalyticModel,
    Surfaces as Surfaces,
    load_model as load_model,
    nominal_model as nominal_model,
    register as register,
    save_model as save_model,
)
from .estimation import (
    Estimate as Estimate,
    ExtendedKalmanFilter as ExtendedKalmanFilter,
    Online as Online,
    RadarSpeed as RadarSpeed,
    Settings as Settings,
    Smoother as Smoother,
    SpinReading as SpinReading,
    Status as Status,
    TrackGraph as TrackGraph,
    read as read,
    register_estimator as register_estimator,
    register_observation as register_observation,
)
from .front import (
    diagnose as diagnose,
    error_budget as error_budget,
    estimate as estimate,
    flights as flights,
    graph as graph,
    predict as predict,
)
from .importing import import_tracks as import_tracks
from .live import Tracker as Tracker
from .prediction import BallState as BallState
from .simulation import simulate as simulate
from .tracks import Ball as Ball, Dataset as Dataset, Track as Track

__version__: str
