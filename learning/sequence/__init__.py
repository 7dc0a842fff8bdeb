"""Baselines that map observations straight to the rest of a track: an LSTM and a conditional diffusion model."""

from ballfg.learning.sequence.architecture import SequenceArchitecture
from ballfg.learning.sequence.launcher import LauncherSettings
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.learning.sequence.trainee import SequenceTrainee

__all__ = ["LauncherSettings", "SequenceArchitecture", "SequencePredictor", "SequenceTrainee"]
