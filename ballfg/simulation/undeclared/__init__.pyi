from .registry import UNDECLARED as UNDECLARED
from .registry import parse_effects as parse_effects
