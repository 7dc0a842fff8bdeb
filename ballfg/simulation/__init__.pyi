from .balls import table_tennis as table_tennis, tennis as tennis
from .cameras import table_rig as table_rig
from .config import (
    MeasurementNoise as MeasurementNoise,
    MotionNoise as MotionNoise,
    SimulationConfig as SimulationConfig,
)
from .scene.config import Clock as Clock, SceneConfig as SceneConfig
from .scene.recording import record as record, write_scene as write_scene
from .synthetic import simulate as simulate
from .undeclared import parse_effects as parse_effects
from .writing import write_simulation as write_simulation
