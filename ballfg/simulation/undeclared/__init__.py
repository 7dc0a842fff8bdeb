"""What may act although no model declares it: every effect of a model file, and some that no model file can name.

The latter test whether an analysis says "unexplained" where it lacks the explanation.
"""

from ballfg.simulation.undeclared.registry import UNDECLARED, parse_effects

__all__ = ["UNDECLARED", "parse_effects"]
