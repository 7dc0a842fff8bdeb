from .belief import Belief as Belief
from .crossing import (
    apex as apex,
    next_contact as next_contact,
    next_crossing as next_crossing,
    plane_crossing as plane_crossing,
)
from .forecast import Forecast as Forecast
from .plane import Plane as Plane
from .propagate import Propagator as Propagator
from .state import BallState as BallState
