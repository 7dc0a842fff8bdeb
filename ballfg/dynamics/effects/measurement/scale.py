"""Scale: the measured lengths are wrong by a factor, one for each axis."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION


class Scale(MeasurementEffect):
    """Each coordinate times 1 + its error, about the origin of the frame."""

    name = "scale"
    sentence = (
        "Measured lengths are too long or too short by a factor along each axis; the same factor on all is another g, "
        "drag, radius and table height."
    )
    decide = "Measure a rod of known length along each axis."
    coefficients = tuple(Coefficient(axis, 0.0, 0.01, "1", -0.5, 0.5) for axis in "xyz")
    rank = 11
    x: Tensor
    y: Tensor
    z: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, stretched."""
        return states[..., POSITION] * (1.0 + vector(self.x, self.y, self.z))
