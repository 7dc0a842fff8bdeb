"""Generic measurement: an error of the measured positions, smooth in place and velocity, for what nobody can name."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION, VELOCITY

AXES: Final = ("x", "y", "z")
TERMS: Final = {
    "x": (0.005, "1"),
    "y": (0.005, "1"),
    "z": (0.005, "1"),
    "xx": (0.005, "1/m"),
    "yy": (0.005, "1/m"),
    "zz": (0.005, "1/m"),
    "xy": (0.005, "1/m"),
    "xz": (0.005, "1/m"),
    "yz": (0.005, "1/m"),
    "vx": (0.001, "s"),
    "vy": (0.001, "s"),
    "vz": (0.001, "s"),
}
"""Terms in the place from the centre and the velocity: standard deviation of the prior and unit; each is worth 5 mm."""
BOUND: Final = 100.0
"""Of each coefficient, in units of its prior's standard deviation."""


class GenericMeasurement(MeasurementEffect):
    """p + sum of c_{axis,term} term axis in place of the position p."""

    name = "generic_measurement"
    sentence = (
        "An error of the measured positions, linear and quadratic in place and linear in velocity; it names no cause."
    )
    decide = "Measure a ball that hangs still at known places, then one that moves slowly and fast on a known path."
    coefficients = (
        *(
            Coefficient(f"{axis}_{term}", 0.0, sigma, unit, -BOUND * sigma, BOUND * sigma)
            for axis in AXES
            for term, (sigma, unit) in TERMS.items()
        ),
        Coefficient("center_x", 1.4, 0.0, "m", -100.0, 100.0, absent=None),
        Coefficient("center_y", 0.0, 0.0, "m", -100.0, 100.0, absent=None),
        Coefficient("center_z", 1.0, 0.0, "m", -100.0, 100.0, absent=None),
    )
    rank = 2
    center_x: Tensor
    center_y: Tensor
    center_z: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, with the error."""
        place = states[..., POSITION] - vector(self.center_x, self.center_y, self.center_z)
        strengths = vector(*(getattr(self, c.name) for c in self.coefficients if c.absent is not None))
        x, y, z = place.split(1, dim=-1)
        terms = torch.cat((place, x * x, y * y, z * z, x * y, x * z, y * z, states[..., VELOCITY]), dim=-1)
        return states[..., POSITION] + (strengths.unflatten(-1, (3, -1)) * terms.unsqueeze(-2)).sum(-1)
