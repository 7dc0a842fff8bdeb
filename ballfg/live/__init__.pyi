from .tracker import BallUpdate as BallUpdate, Tracker as Tracker
