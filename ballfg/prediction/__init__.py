"""Where the ball will be: rollouts, the apex, the next contact, a plane - with covariance."""

from ballfg.prediction.belief import Belief
from ballfg.prediction.crossing import Crossing, apex, next_contact, next_crossing, plane_crossing
from ballfg.prediction.propagate import Prediction, Propagator
from ballfg.prediction.tracks import TrackPrediction, check_observe, predict_tracks

__all__ = [
    "Belief",
    "Crossing",
    "Prediction",
    "Propagator",
    "TrackPrediction",
    "apex",
    "check_observe",
    "next_contact",
    "next_crossing",
    "plane_crossing",
    "predict_tracks",
]
