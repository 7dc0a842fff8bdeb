from .ball import BallEvent as BallEvent
from .tracker import BallUpdate as BallUpdate
from .tracker import Counts as Counts
from .tracker import Tracker as Tracker
