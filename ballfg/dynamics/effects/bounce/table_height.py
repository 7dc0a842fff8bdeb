"""The table's true height: surfaces lie where balls bounce, not where somebody measured them to be."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient


class TableHeight(BounceEffect):
    """Surfaces lie `offset` above their declared height.

    In measured tracks the bounce lies 2 to 4 mm lower than a rigid ball on the declared table would (docs/physics.md):
    calibration, and the ball's compression during a contact of about 1 ms.
    """

    name = "table_height"
    sentence = "Surfaces lie higher or lower than declared."
    decide = "Lay the ball on the table and measure its position; vary the steepness of the impacts."
    coefficients = (Coefficient("offset", 0.0, 0.004, "m", -0.2, 0.2, varies=True),)
    offset: Tensor

    def surface_offset(self, position: Tensor) -> Tensor:
        """() or (..., 1) m."""
        return self.offset
