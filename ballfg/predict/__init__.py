"""Where the ball will be: rollouts, the apex, the next contact, a plane - with covariance."""

from ballfg.predict.belief import Belief
from ballfg.predict.crossing import Crossing, apex, next_contact, next_crossing, plane_crossing
from ballfg.predict.propagate import Prediction, Propagator
from ballfg.predict.tracks import TrackPrediction, check_observe, predict_tracks

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
