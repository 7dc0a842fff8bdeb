from .registration import load_effects as load_effects
from .registration import register as register
from .registry import EFFECTS as EFFECTS
from .registry import effect_class as effect_class
