"""Physical effects, the registry that names them, and effects of one's own."""

from ballfg.dynamics.effects.registry import EFFECTS, effect_class, load_effects, register

__all__ = ["EFFECTS", "effect_class", "load_effects", "register"]
