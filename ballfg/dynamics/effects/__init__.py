"""One physical effect a file, and the registry that names them."""

from ballfg.dynamics.effects.registry import EFFECTS, effect_class

__all__ = ["EFFECTS", "effect_class"]
