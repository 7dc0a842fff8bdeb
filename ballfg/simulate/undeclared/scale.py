"""Scale: the measured lengths are wrong by a factor, one for each axis."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.simulate.undeclared.base import Advance, MeasurementEffect


class Scale(MeasurementEffect):
    """Each coordinate times 1 + its error, about the origin of the frame."""

    name = "scale"
    sentence = "Measured lengths are too long or too short by a factor along each axis."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "1", -0.5, 0.5) for axis in "xyz")
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, advance: Advance) -> Tensor:
        """(n, 3) m, stretched."""
        return states[:, :3] * (1.0 + vector(self.x, self.y, self.z))
