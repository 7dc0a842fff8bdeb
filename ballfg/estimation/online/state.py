"""What an online estimator knows after an observation."""

from dataclasses import dataclass

from ballfg.arrays import Array
from ballfg.estimation.result import Status
from ballfg.estimation.smoother.motion import Motion
from ballfg.prediction.state import BallState


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OnlineState(BallState):
    """The state of the ball after a measurement, and what the update did.

    Attributes:
        innovation: (3,) the position against its prediction, whitened, (2,) of a sighting; NaN where nothing
            predicted it.
        motion: how the ball got here from the last observation.
        revised: how many of the last samples were taken back and explained anew.
        evaluated: factors of the motion evaluated.  calls: torch calls for them.
        rebuilt: iSAM2 failed, and the window was built anew.
        status: OK, or what to try.
    """

    innovation: Array
    motion: Motion
    revised: int
    evaluated: int
    calls: int
    rebuilt: bool
    status: Status
