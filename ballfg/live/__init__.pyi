from .tracker import BallUpdate as BallUpdate
from .tracker import Tracker as Tracker
