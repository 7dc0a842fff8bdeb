"""States carried forward: rollouts, the apex, the next contact, a plane - with covariance."""

from ballfg.prediction.ahead import Ahead, look_ahead
from ballfg.prediction.belief import Belief
from ballfg.prediction.crossing import Crossing, apex, next_contact, next_crossing, plane_crossing
from ballfg.prediction.propagate import Prediction, Propagator
from ballfg.prediction.state import BallState, World

__all__ = [
    "Ahead",
    "BallState",
    "Belief",
    "Crossing",
    "Prediction",
    "Propagator",
    "World",
    "apex",
    "look_ahead",
    "next_contact",
    "next_crossing",
    "plane_crossing",
]
