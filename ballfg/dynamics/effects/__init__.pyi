from .registry import EFFECTS as EFFECTS
from .registry import effect_class as effect_class
from .registry import load_effects as load_effects
from .registry import register as register
