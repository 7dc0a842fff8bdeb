"""An online state is the belief after an observation, with a record of the update."""

from dataclasses import dataclass

from ballfg.arrays import Array
from ballfg.estimation.result import Status
from ballfg.estimation.smoother.motion import Motion
from ballfg.prediction.state import BallState


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OnlineState(BallState):
    """The state of the ball after a measurement, with a record of the update.

    Attributes:
        innovation: (3,) the position against its prediction, whitened, (2,) of a sighting; NaN without a prediction.
        motion: how the ball moved since the last observation.
        revised: number of last samples that were retracted and explained anew.
        evaluated: number of evaluated factors of the motion.  calls: number of torch calls for them.
        rebuilt: True if iSAM2 failed and the window was rebuilt.
        status: OK, or a remedy.
    """

    innovation: Array
    motion: Motion
    revised: int
    evaluated: int
    calls: int
    rebuilt: bool
    status: Status
