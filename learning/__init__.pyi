from .config.config_file import read_config as read_config
from .config.training import TrainConfig as TrainConfig
from .gradient.implicit import ImplicitGradient as ImplicitGradient
from .run.training import build as build, run_training as run_training
from .trainee import (
    BatchLoss as BatchLoss,
    Prepared as Prepared,
    Trainee as Trainee,
    TraineeKind as TraineeKind,
    register_trainee as register_trainee,
)
from .training_data import read_training_data as read_training_data
