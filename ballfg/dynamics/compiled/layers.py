"""Computes matrix products and tanh for the network layers in generated functions, each compiled only once."""

from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE, TWO

LEAST_FOR_BLAS: Final = 256
"""Multiplications from which on a call of BLAS is quicker than loops; ten times so for layers of 80."""

ROUNDING: Final = 1.5 * 2.0**52  # Added to a float64, it leaves the nearest whole number in the lowest bits
PER_LN2: Final = 1.4426950408889634
LN2: Final = 6.93147180369123816490e-01
LN2_REST: Final = 1.90821492927058770002e-10  # ln 2 in two parts, the first of which times a whole number is exact
BITS, BIAS = np.int64(52), np.int64(1023 << 52)  # Place of the exponent in a float64
STEEP: Final = 0.625  # Below, 1 - 2 / (exp(2x) + 1) would lose digits


@machine_code(NOTHING(ONE, ONE, TWO))
def _add_row(whole: Array, row: Array, matrix: Array) -> None:
    """Add the product of a row (k,) and a matrix (k, n) to `whole` (n,); BLAS takes twice as long for one row."""
    k, n = matrix.shape
    fours = k - k % 4  # four rows at a time, since each pass reads and writes `whole`
    for r in range(0, fours, 4):
        a, b, c, d = row[r], row[r + 1], row[r + 2], row[r + 3]
        one, two, three, four = matrix[r], matrix[r + 1], matrix[r + 2], matrix[r + 3]
        for j in range(n):
            whole[j] += a * one[j] + b * two[j] + c * three[j] + d * four[j]
    for r in range(fours, k):
        factor, last = row[r], matrix[r]
        for j in range(n):
            whole[j] += factor * last[j]


@machine_code(NOTHING(ONE, COUNT, COUNT, *(ONE, *[COUNT] * 4) * 2, *[COUNT] * 4))
def add_product(
    whole: Array, whole_at: int, whole_step: int,
    left: Array, left_at: int, left_step: int, left_row: int, left_column: int,
    right: Array, right_at: int, right_step: int, right_row: int, right_column: int,
    count: int, m: int, k: int, n: int,
) -> None:  # fmt: skip
    """Add matrix products (m, k) (k, n) to `whole`, whose rows lie one behind another.

    Args:
        whole, left, right: flat arrays in which the matrices lie; their numbers have the unit of what they stand for.
        whole_at, left_at, right_at: place of the first entry.
        whole_step, left_step, right_step: from a matrix to the same one of the next product; 0 if it is the same.
        left_row, left_column, right_row, right_column: from an entry to that of the next row or column.
        count: number of products.
    """
    in_rows = left_column == 1 and (m == 1 or left_row == k)
    upright, turned = right_column == 1 and right_row == n, right_row == 1 and right_column == k
    if in_rows and upright and m * count == 1:
        matrix = right[right_at : right_at + k * n].reshape(k, n)
        _add_row(whole[whole_at : whole_at + n], left[left_at : left_at + k], matrix)
        return
    if not (in_rows and (upright or turned) and m * k * n * count >= LEAST_FOR_BLAS):
        for q in range(count):
            for i in range(m):
                into = whole_at + q * whole_step + i * n
                for r in range(k):
                    factor = left[left_at + q * left_step + i * left_row + r * left_column]
                    place = right_at + q * right_step + r * right_row
                    for j in range(n):
                        whole[into + j] += factor * right[place + j * right_column]
        return
    joined = right_step == 0 and left_step == m * k and whole_step == m * n
    rows, times = (count * m, 1) if joined else (m, count)
    for q in range(times):
        at = left_at + q * left_step
        one = left[at : at + rows * k].reshape(rows, k)
        at = right_at + q * right_step
        other = right[at : at + k * n]
        into = whole_at + q * whole_step
        sums = whole[into : into + rows * n].reshape(rows, n)
        if upright:
            sums += np.dot(one, other.reshape(k, n))
        else:
            sums += np.dot(one, other.reshape(n, k).T)


@machine_code(NOTHING(ONE, ONE))
def tanh_all(x: Array, y: Array) -> None:
    """Write tanh of x (n,) without unit to y (n,), to some units in the last place; NaN stays NaN.

    Several numbers are computed by one instruction, where libm computes one after another.
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
