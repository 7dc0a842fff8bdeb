"""Products of matrices inside of generated functions: one piece of machine code for all, which is compiled once."""

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE


@machine_code(NOTHING(ONE, COUNT, *(ONE, *[COUNT] * 4) * 2, *[COUNT] * 4))
def add_product(
    whole: Array,
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
        left_at, right_at: place of the first entry.
        whole_step, left_step, right_step: from a matrix to the same one of the next product; 0 if it is the same.
        left_row, left_column, right_row, right_column: from an entry to that of the next row or column.
        count: number of products.
    """
    for q in range(count):
        for i in range(m):
            into = q * whole_step + i * n
            for r in range(k):
                factor = left[left_at + q * left_step + i * left_row + r * left_column]
                place = right_at + q * right_step + r * right_row
                if right_column == 1:  # along a row in memory: several at once
                    for j in range(n):
                        whole[into + j] += factor * right[place + j]
                else:
                    for j in range(n):
                        whole[into + j] += factor * right[place + j * right_column]
