from .belief import Belief as Belief
from .crossing import apex as apex
from .crossing import next_contact as next_contact
from .crossing import next_crossing as next_crossing
from .crossing import plane_crossing as plane_crossing
from .forecast import Forecast as Forecast
from .propagate import Propagator as Propagator
from .state import BallState as BallState
