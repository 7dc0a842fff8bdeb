"""Defines the state of a ball as a 9-vector of position, velocity and spin, in SI units.

State tensors and arrays have shape (..., 9), float64: position m, velocity m/s, spin (angular velocity)
rad/s, in a right-handed world frame with z up.
"""

from typing import Final

STATE_DIM: Final = 9
POSITION: Final = slice(0, 3)
VELOCITY: Final = slice(3, 6)
SPIN: Final = slice(6, 9)
Z: Final = 2
VZ: Final = 5

STATE_NAMES: Final = ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")
SIGMA_NAMES: Final = tuple(f"sigma_{name}" for name in STATE_NAMES)
CORRELATIONS: Final = {"rho_xy": (0, 1), "rho_xz": (0, 2), "rho_yz": (1, 2)}
"""Columns of tables with the correlations of a position, and its coordinates."""

STANDARD_GRAVITY: Final = 9.81  # m/s^2
