"""The hyperbolic tangent of many numbers: several at once per instruction, where libm computes one after another."""

from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import NOTHING, ONE

ROUNDING: Final = 1.5 * 2.0**52
"""Added to a float64, it leaves the nearest whole number in the lowest bits."""
PER_LN2: Final = 1.4426950408889634
LN2: Final = 6.93147180369123816490e-01
LN2_REST: Final = 1.90821492927058770002e-10
"""ln 2 in two parts, the first of which times a whole number is exact."""
BITS, BIAS = np.int64(52), np.int64(1023 << 52)
"""Where a float64 has its exponent."""
STEEP: Final = 0.625
"""Below, 1 - 2 / (exp(2x) + 1) would lose digits."""


@machine_code(NOTHING(ONE, ONE))
def tanh_all(x: Array, y: Array) -> None:
    """Write tanh of x (n,) without unit to y (n,), to some units in the last place; NaN stays NaN.

    exp(-2 |x|) = 2^k exp(r) with |r| <= ln 2 / 2, from exp's series; near zero Cephes's rational function.
    """
    n = len(x)
    power, series = np.empty(n), np.empty(n)
    bits = power.view(np.int64)
    for i in range(n):
        v = -2.0 * min(abs(x[i]), 20.0)
        shifted = v * PER_LN2 + ROUNDING
        k = shifted - ROUNDING
        r = (v - k * LN2) - k * LN2_REST
        s = 1.0 / 6227020800.0
        s = s * r + 1.0 / 479001600.0
        s = s * r + 1.0 / 39916800.0
        s = s * r + 1.0 / 3628800.0
        s = s * r + 1.0 / 362880.0
        s = s * r + 1.0 / 40320.0
        s = s * r + 1.0 / 5040.0
        s = s * r + 1.0 / 720.0
        s = s * r + 1.0 / 120.0
        s = s * r + 1.0 / 24.0
        s = s * r + 1.0 / 6.0
        s = s * r + 0.5
        s = s * r + 1.0
        s = s * r + 1.0
        power[i], series[i] = shifted, s
    for i in range(n):
        bits[i] = (bits[i] << BITS) + BIAS
    for i in range(n):
        e = series[i] * power[i]
        v, square = x[i], x[i] * x[i]
        far = (1.0 - e) / (1.0 + e)
        above = (-9.64399179425052238628e-1 * square - 9.92877231001918586564e1) * square - 1.61468768441708447952e3
        below = (square + 1.12811678491632931402e2) * square + 2.23548839060100448583e3
        near = v + v * square * (above / (below * square + 4.84406305325125486048e3))
        far = far if v > 0.0 else -far
        y[i] = far if abs(v) >= STEEP else near
