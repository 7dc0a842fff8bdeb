from .architecture import SequenceArchitecture as SequenceArchitecture
from .data import LauncherSettings as LauncherSettings
from .predictor import SequencePredictor as SequencePredictor
from .trainee import SequenceTrainee as SequenceTrainee
