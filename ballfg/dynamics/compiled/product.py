"""Products of matrices inside of generated functions: one piece of machine code for all, which is compiled once."""

from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE

LEAST_FOR_BLAS: Final = 256
"""Multiplications from which on a call of BLAS is quicker than loops; ten times so for layers of 80."""


@machine_code(NOTHING(ONE, COUNT, COUNT, *(ONE, *[COUNT] * 4) * 2, *[COUNT] * 4))
def add_product(
    whole: Array,
    whole_at: int,
    whole_step: int,
    left: Array,
    left_at: int,
    left_step: int,
    left_row: int,
    left_column: int,
    right: Array,
    right_at: int,
    right_step: int,
    right_row: int,
    right_column: int,
    count: int,
    m: int,
    k: int,
    n: int,
) -> None:
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
