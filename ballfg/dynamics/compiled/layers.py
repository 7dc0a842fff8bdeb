"""Computes matrix products and tanh for the network layers in generated functions, each compiled only once."""

import math
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, ONE

FEW, NARROW = 12, 16
"""Rows up to which loops are quicker than BLAS, which copies the other matrix first: four times so for three rows; and
the length of that matrix's shorter side."""

ROUNDING: Final = 1.5 * 2.0**52  # Added to a float64, it leaves the nearest whole number in the lowest bits
PER_LN2: Final = 1.4426950408889634
LN2: Final = 6.93147180369123816490e-01
LN2_REST: Final = 1.90821492927058770002e-10  # ln 2 in two parts, the first of which times a whole number is exact
BITS, BIAS = np.int64(52), np.int64(1023 << 52)  # Place of the exponent in a float64


@machine_code(NOTHING(ONE, ONE, ONE, COUNT, COUNT, COUNT), may=("contract",))
def _add_rows(sums: Array, rows: Array, matrix: Array, m: int, k: int, n: int) -> None:
    """Add the product of rows (m, k) and a matrix (k, n) to sums (m, n), all of them flat."""
    fours = k - k % 4  # four rows of the matrix at a time, since each pass reads and writes `sums`
    for r in range(0, fours, 4):
        one, two = matrix[r * n : (r + 1) * n], matrix[(r + 1) * n : (r + 2) * n]
        three, four = matrix[(r + 2) * n : (r + 3) * n], matrix[(r + 3) * n : (r + 4) * n]
        for i in range(m):
            a, b, c, d = rows[i * k + r], rows[i * k + r + 1], rows[i * k + r + 2], rows[i * k + r + 3]
            into = sums[i * n : (i + 1) * n]
            for j in range(n):
                into[j] += a * one[j] + b * two[j] + c * three[j] + d * four[j]
    for r in range(fours, k):
        last = matrix[r * n : (r + 1) * n]
        for i in range(m):
            factor, into = rows[i * k + r], sums[i * n : (i + 1) * n]
            for j in range(n):
                into[j] += factor * last[j]


@machine_code(NOTHING(ONE, ONE, ONE, COUNT, COUNT, COUNT), may=("contract", "reassoc"))
def _add_turned(sums: Array, rows: Array, turned: Array, m: int, k: int, n: int) -> None:
    """`_add_rows` of a matrix whose columns are rows of `turned` (n, k): quicker than the other unless k is small."""
    fours = n - n % 4  # four columns at a time, which stay in the cache
    for j in range(0, fours, 4):
        one, two = turned[j * k : (j + 1) * k], turned[(j + 1) * k : (j + 2) * k]
        three, four = turned[(j + 2) * k : (j + 3) * k], turned[(j + 3) * k : (j + 4) * k]
        for i in range(m):
            row, a, b, c, d = rows[i * k : (i + 1) * k], 0.0, 0.0, 0.0, 0.0
            for r in range(k):
                a += row[r] * one[r]
                b += row[r] * two[r]
                c += row[r] * three[r]
                d += row[r] * four[r]
            sums[i * n + j] += a
            sums[i * n + j + 1] += b
            sums[i * n + j + 2] += c
            sums[i * n + j + 3] += d
    for j in range(fours, n):
        last = turned[j * k : (j + 1) * k]
        for i in range(m):
            row, a = rows[i * k : (i + 1) * k], 0.0
            for r in range(k):
                a += row[r] * last[r]
            sums[i * n + j] += a


@machine_code(NOTHING(ONE, ONE, ONE, COUNT, COUNT, COUNT, FLAG, FLAG))
def _by_blas(sums: Array, rows: Array, matrix: Array, m: int, k: int, n: int, upright: bool, anew: bool) -> None:
    """`_add_rows`, or `_add_turned` unless `upright`; `anew`: without what `sums` held."""
    into = sums.reshape(m, n) if anew else np.empty((m, n))
    if upright:
        np.dot(rows.reshape(m, k), matrix.reshape(k, n), into)
    else:
        np.dot(rows.reshape(m, k), matrix.reshape(n, k).T, into)
    if not anew:
        for i, product in enumerate(into.flat):
            sums[i] += product


@machine_code(NOTHING(ONE, COUNT, COUNT, COUNT, COUNT))
def _clear(whole: Array, at: int, step: int, count: int, size: int) -> None:
    """Write zeros to so many matrices of a size."""
    for q in range(count):
        one = whole[at + q * step : at + q * step + size]
        for i in range(size):
            one[i] = 0.0


@machine_code(NOTHING(ONE, COUNT, COUNT, *(ONE, *[COUNT] * 4) * 2, *[COUNT] * 5))
def add_product(
    whole: Array, whole_at: int, whole_step: int,
    left: Array, left_at: int, left_step: int, left_row: int, left_column: int,
    right: Array, right_at: int, right_step: int, right_row: int, right_column: int,
    count: int, m: int, k: int, n: int, anew: int,
) -> None:  # fmt: skip
    """Add matrix products (m, k) (k, n) to `whole`, whose rows lie one behind another.

    Args:
        whole, left, right: flat arrays in which the matrices lie; their numbers have the unit of what they stand for.
        whole_at, left_at, right_at: place of the first entry.
        whole_step, left_step, right_step: from a matrix to the same one of the next product; 0 if it is the same.
        left_row, left_column, right_row, right_column: from an entry to that of the next row or column.
        count: number of products.  anew: 1 if `whole` holds nothing yet.
    """
    in_rows = left_column == 1 and (m == 1 or left_row == k)
    upright, turned = right_column == 1 and right_row == n, right_row == 1 and right_column == k
    joined = right_step == 0 and left_step == m * k and whole_step == m * n
    rows, times = (count * m, 1) if joined else (m, count)
    by_blas = in_rows and (upright or turned) and rows > FEW and min(k, n) > NARROW
    if anew and not by_blas:
        _clear(whole, whole_at, whole_step, count, m * n)
    if not (in_rows and (upright or turned)):
        for q in range(count):
            for i in range(m):
                into = whole_at + q * whole_step + i * n
                for r in range(k):
                    factor = left[left_at + q * left_step + i * left_row + r * left_column]
                    place = right_at + q * right_step + r * right_row
                    for j in range(n):
                        whole[into + j] += factor * right[place + j * right_column]
        return
    for q in range(times):
        at, there, here = left_at + q * left_step, right_at + q * right_step, whole_at + q * whole_step
        one, other, sums = left[at : at + rows * k], right[there : there + k * n], whole[here : here + rows * n]
        if by_blas:
            _by_blas(sums, one, other, rows, k, n, upright, anew)
        elif upright:
            _add_rows(sums, one, other, rows, k, n)
        else:
            _add_turned(sums, one, other, rows, k, n)


@machine_code(NOTHING(ONE, ONE), may=("contract",))
def tanh_all(x: Array, y: Array) -> None:
    """Write tanh of x (n,) without unit to y (n,), to two units in the last place; NaN stays NaN.

    Several numbers are computed by one instruction, where libm computes one after another. With -2 |x| = k ln 2 + r, of
    which |r| <= ln 2 / 2, and s = 2^k it is ((1 - s) R - (1 + s) r) / ((1 + s) R - (1 - s) r) for R = r coth(r / 2), a
    series in r^2. Nothing is lost near zero, where s = 1 and R is 2.

    Source: the coefficients are those of `exp` in fdlibm 5.3 (Sun Microsystems), `e_exp.c`.
    """
    for i in range(len(x)):
        v = -2.0 * min(abs(x[i]), 20.0)
        shifted = v * PER_LN2 + ROUNDING
        k = shifted - ROUNDING
        r = (v - k * LN2) - k * LN2_REST
        square = r * r
        series = 4.13813679705723846039e-08 * square - 1.65339022054652515390e-06
        series = (series * square + 6.61375632143793436117e-05) * square - 2.77777777770155933842e-03
        series = (series * square + 1.66666666666666019037e-01) * square + 2.0
        s = np.int64((np.float64(shifted).view(np.int64) << BITS) + BIAS).view(np.float64)
        less, more = 1.0 - s, 1.0 + s
        y[i] = math.copysign((less * series - more * r) / (more * series - less * r), x[i])
