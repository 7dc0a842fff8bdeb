"""Linear factors keep the information of removed states.

The rows of linear factors in a chain are kept once, about zero: a moved state changes only their right side.
"""

import math
from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, INDEX, NOTHING, ONE, TWO
from ballfg.factors.batch import COEFFICIENTS, FactorBatch
from ballfg.factors.loss import weight_of
from ballfg.state import STATE_DIM


class LinearFactors(FactorBatch):
    """One linear factor r = sum A_i (v_i - v_i*) - b, with the information of removed states.

    Args:
        numbers: of its variables v_i.  points: (1, d) each, v_i* in the variable's own units.
        blocks: (r, d) each, A_i whitened, per unit of the variable.  b: (r,) whitened.
        sees_biases: True if biases follow the states.
    """

    def __init__(
        self, numbers: Sequence[int], points: Sequence[Array], blocks: Sequence[Array], b: Array, sees_biases: bool
    ) -> None:
        super().__init__(np.array([numbers]), len(b))
        self.sees_biases = sees_biases  # type: ignore[misc]  # the class's is that of states alone
        self.points, self.blocks, self.b = tuple(points), tuple(blocks), b

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)


class LinearRows:
    """The rows J x = b of linear factors on a state, the next one and the coefficients, in the columns of a chain.

    Args:
        batches: of one factor each.  width: w, numbers of a state.  p: number of coefficients.
        columns: of the chain's rows, (x_i, x_{i+1}, c, 0, b).

    Attributes:
        rows: (r, columns) whitened.
        losses: (g, 3) of each batch with a robust loss: first row, end, the loss's number.  scales: (g,) theirs.
    """

    def __init__(self, batches: Sequence[FactorBatch], width: int, p: int, columns: int) -> None:
        self.rows, self.width = np.zeros((sum(batch.dim for batch in batches), columns)), width
        losses, row = list[tuple[int, int, int]](), 0
        for batch in batches:
            part = self.rows[row : row + batch.dim]
            own, seen = width if batch.sees_biases else STATE_DIM, batch.variables[0].tolist()
            origin = tuple(np.zeros((1, p if variable == COEFFICIENTS else own)) for variable in seen)
            (residual,), blocks = batch.compute(slice(None), origin)
            write_factor(batch, blocks, width, part)
            part[:, -1] = -residual
            if batch.loss.name != "squared":
                losses.append((row, row + batch.dim, batch.loss.kind))
            row += batch.dim
        self.losses = np.array(losses, dtype=np.int64).reshape(-1, 3)
        self.scales = np.array([batch.loss.scale for batch in batches if batch.loss.name != "squared"])

    @property
    def dim(self) -> int:
        """Number of rows."""
        return len(self.rows)

    def write(self, state: Array, after: Array, coefficients: Array, rows: Array) -> None:
        """Writes the rows about other points into the first of `rows` (.., columns), weighted by robust losses.

        Args: state, after: (w,) points of the state and the next one.  coefficients: (p,).
        """
        _about(self.rows, self.losses, self.scales, self.width, state, after, coefficients, rows)


def write_factor(batch: FactorBatch, blocks: Sequence[Array], width: int, rows: Array) -> None:
    """Writes the Jacobians (1, r, d) of a batch of one factor into the columns of its variables, rows (r, columns)."""
    place = 0
    for variable, (block,) in zip(batch.variables[0].tolist(), blocks, strict=True):
        at = 2 * width if variable == COEFFICIENTS else place
        rows[:, at : at + block.shape[1]] = block
        place += width


@machine_code(NOTHING(TWO, INDEX, ONE, COUNT, ONE, ONE, ONE, TWO))
def _about(
    linear: Array,
    losses: Index,
    scales: Array,
    width: int,
    state: Array,
    after: Array,
    coefficients: Array,
    rows: Array,
) -> None:
    """As `LinearRows.write`."""
    columns = linear.shape[1]
    for i in range(len(linear)):
        right = linear[i, columns - 1]
        for j in range(columns - 1):
            rows[i, j] = linear[i, j]
        for j in range(width):
            right -= linear[i, j] * state[j] + linear[i, width + j] * after[j]
        for j in range(len(coefficients)):
            right -= linear[i, 2 * width + j] * coefficients[j]
        rows[i, columns - 1] = right
    for g in range(len(losses)):
        begin, end, square = losses[g, 0], losses[g, 1], 0.0
        for i in range(begin, end):
            square += rows[i, columns - 1] ** 2
        weight = math.sqrt(weight_of(losses[g, 2], scales[g], square))
        for i in range(begin, end):
            for j in range(columns):
                rows[i, j] *= weight
