"""The bridge passes every row of a batch of factors to GTSAM as a CustomFactor, evaluated in one call.

GTSAM asks for one factor at a time, in C++ order; torch is quick only on batches. A `Bridge` caches the last residual
and Jacobians of every row together with the exact bytes of their inputs. A call with the same inputs gets the cached
result; any other call is a miss. docs/custom_factors.md is the contract.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Rows, Values, shaped
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.step import weighted
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    import gtsam

OnMiss = Literal["changed", "row"]

STATE_KEY, COEFFICIENT_KEY = ord("x") << 56, ord("c") << 56
"""The keys x0 and c0 as GTSAM numbers them: it takes a tenth of a second to import, and a chain needs none of it."""

Callback: TypeAlias = "Callable[[gtsam.CustomFactor, gtsam.Values, gtsam.JacobianVector | None], Array]"


def key_of(variable: int) -> int:
    """GTSAM's key of a variable number: x0, x1, ... for states, c0 for the coefficients."""
    return COEFFICIENT_KEY if variable == COEFFICIENTS else STATE_KEY + variable


class Bridge:
    """Evaluates one batch of factors for GTSAM.

    A bridge never refers to the factors that it made: a factor holds its callback, the callback the bridge, the bridge
    the batch. With a reference back the chain would be a cycle through C++, which Python's collector cannot see.

    If the tracker's biases follow GTSAM's states, a batch without biases sees the states alone; its Jacobians get
    columns of zeros.

    Args:
        batch: whitens its residuals itself; its loss goes into the factors' noise model.
        on_miss: `changed` evaluates all rows whose inputs differ from the cached ones, in one call: right for solvers
            that move all variables at once. `row` evaluates the requested row alone: for iSAM2, where the caller
            prepares the rows in advance and a miss is an unexpected row.

    A row that is not finite raises. One question is excepted: an optimizer that moves all variables judges a step by
    residuals alone. It gets an infinite residual, and takes a shorter step.

    Attributes:
        calls: number of evaluations of the batch.
        misses: number of callbacks without a prepared result.

    Raises: ValueError: if `on_miss` is neither of the two.
    """

    def __init__(self, batch: FactorBatch, on_miss: OnMiss = "changed") -> None:
        if on_miss not in ("changed", "row"):
            raise ValueError(f"on_miss must be 'changed' or 'row'; got '{on_miss}'")
        self.batch = batch
        self.on_miss = on_miss
        self.calls = 0
        self.misses = 0
        self._inputs: list[tuple[Array, ...] | None] = [None] * len(batch)
        self._answers: list[tuple[Array, tuple[Array, ...]] | None] = [None] * len(batch)

    def factor(self, row: int, variables: Sequence[int] | None = None) -> "gtsam.CustomFactor":
        """The CustomFactor of one row; its noise model has unit sigmas and the batch's loss.

        Args:
            row: of the batch.
            variables: variable numbers to use in place of the batch's own.
        """
        numbers = self.batch.variables[row].tolist() if variables is None else variables
        keys = [key_of(v) for v in numbers]
        import gtsam

        return gtsam.CustomFactor(self.batch.loss.noise_model(self.batch.dim), keys, _callback(self, row, keys))

    def factors(self) -> "list[gtsam.CustomFactor]":
        """One factor a row."""
        return [self.factor(row) for row in range(len(self.batch))]

    def prepare(self, rows: Index, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Evaluates rows in one call, checks the results and caches them for the callbacks.

        Args:
            rows: (k,) index of the rows.
            inputs: for each variable of a factor its values (k, d), in the variable's own units.
        Returns: residuals (k, r) and Jacobians (k, r, d), whitened, as cached.
        Raises: ValueError: if the batch returns a wrong shape, another type than float64 or a value that is not finite.
        """
        own = [np.array(block, dtype=np.float64, order="C") for block in inputs]  # the caller may change its own
        inputs = tuple(own)
        self.calls += 1
        residual, jacobians = checked(self.batch, rows, inputs, *self.batch.compute(rows, inputs))
        for k, row in enumerate(rows.tolist()):
            self.keep(row, tuple([x[k] for x in inputs]), residual[k], tuple([j[k] for j in jacobians]))
        return residual, jacobians

    def _try(self, rows: Index, inputs: tuple[Array, ...]) -> None:
        """`prepare` for a trial point: of rows that are not finite, only the inputs are cached."""
        self.calls += 1
        with np.errstate(over="ignore", invalid="ignore"):
            residual, jacobians = shaped(self.batch, inputs, *self.batch.compute(rows, inputs))
        finite = np.asarray(np.isfinite(residual).all(axis=1))
        for block in jacobians:
            finite &= np.isfinite(block).all(axis=(1, 2))
        for k, row in enumerate(rows.tolist()):
            self.keep(row, tuple([x[k] for x in inputs]), residual[k], tuple([j[k] for j in jacobians]))
            if not finite[k]:
                self._answers[row] = None

    def keep(self, row: int, inputs: tuple[Array, ...], residual: Array, jacobians: tuple[Array, ...]) -> None:
        """Caches a result that the caller computed itself and checked by `checked`.

        Args:
            row: of the batch.
            inputs: for each variable of the factor its value (d,), in the variable's own units; nobody changes it.
            residual: (r,) whitened.
            jacobians: for each variable (r, d) whitened, per unit of the variable.
        """
        self._inputs[row], self._answers[row] = inputs, (residual, jacobians)

    def kept(self, row: int) -> tuple[Array, tuple[Array, ...]]:
        """Residual (r,) and Jacobians (r, d), whitened, of a row that was prepared or cached last."""
        found = self._answers[row]
        assert found is not None
        return found

    def answer(
        self, row: int, keys: Sequence[int], values: "gtsam.Values", *, trial: bool = False
    ) -> tuple[Array, tuple[Array, ...]]:
        """Residual (r,) and Jacobians (r, d), whitened, of a row at GTSAM's values.

        Args:
            row: of the batch.
            keys: GTSAM's, of its variables.
            values: GTSAM's, with those keys.
            trial: True if only the residual is needed; there are no Jacobians then, and a residual that is not finite
                becomes infinite.
        Raises: ValueError: as `prepare`.
        """
        vectors = [values.atVector(key) for key in keys]
        asked = tuple([self._seen(key, vector).tobytes() for key, vector in zip(keys, vectors, strict=True)])
        if asked != self._seen_last(row):
            self.misses += 1
            self._evaluate(row, keys, values)
        if self._answers[row] is None:
            if not trial:
                raise ValueError(_not_finite(f"{type(self.batch).__name__}.compute: residual and Jacobians", row))
            return np.full(self.batch.dim, np.inf), ()
        residual, blocks = self.kept(row)
        if trial:
            return residual, ()
        return residual, tuple([_widened(block, len(v)) for block, v in zip(blocks, vectors, strict=True)])

    def _seen_last(self, row: int) -> tuple[bytes, ...] | None:
        """The inputs of a row's cached result, bit by bit."""
        inputs = self._inputs[row]
        return None if inputs is None else tuple([x.tobytes() for x in inputs])

    def _seen(self, key: int, vector: Array) -> Array:
        """The part of one of GTSAM's vectors that the batch uses."""
        return vector if self.batch.sees_biases or key == COEFFICIENT_KEY else vector[:STATE_DIM]

    def _evaluate(self, row: int, keys: Sequence[int], values: "gtsam.Values") -> None:
        if self.on_miss == "row":
            self.prepare(np.array([row]), tuple(self._seen(key, values.atVector(key))[None] for key in keys))
            return
        vectors: dict[int, Array] = {}
        rows, columns = [], []
        for r, variables in enumerate(self.batch.variables.tolist()):
            held = [_vector(values, v, vectors) for v in variables]
            if any(p is None for p in held):
                continue  # a graph of some of the rows only
            point = [self._seen(key_of(v), p) for v, p in zip(variables, held, strict=True) if p is not None]
            if r == row or tuple(p.tobytes() for p in point) != self._seen_last(r):
                rows.append(r)
                columns.append(point)
        self._try(np.array(rows), tuple(np.stack(column) for column in zip(*columns, strict=True)))


def _widened(block: Array, width: int) -> Array:
    """A Jacobian (r, d) with columns of zeros behind it, so that it has `width` of them."""
    if block.shape[1] == width:
        return block
    wide = np.zeros((len(block), width))
    wide[:, : block.shape[1]] = block
    return wide


def _vector(values: "gtsam.Values", variable: int, known: dict[int, Array]) -> Array | None:
    """A variable's vector, read from GTSAM once; None if GTSAM does not have it."""
    if variable not in known:
        key = key_of(variable)
        if not values.exists(key):
            return None
        known[variable] = values.atVector(key)
    return known[variable]


def _callback(bridge: Bridge, row: int, keys: Sequence[int]) -> Callback:
    """The error function of one factor. `values` and `jacobians` are GTSAM's: valid inside the call only."""

    def error(_: "gtsam.CustomFactor", values: "gtsam.Values", jacobians: "gtsam.JacobianVector | None") -> Array:
        residual, blocks = bridge.answer(row, keys, values, trial=jacobians is None)
        if jacobians is not None:
            for i, block in enumerate(blocks):
                jacobians[i] = block
        return residual

    return error


def checked(
    batch: FactorBatch, rows: Index | slice, inputs: tuple[Array, ...], residual: Array, jacobians: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...]]:
    """The results of a batch, contiguous, after checks: GTSAM would crash the interpreter, or compute with wrong ones.

    Raises: ValueError: names the batch, the array, the row and the rule.
    """
    residual, jacobians = shaped(batch, inputs, residual, jacobians)
    named = [("residual", residual), *((f"Jacobian {i}", block) for i, block in enumerate(jacobians))]
    for label, array in named:
        if not np.isfinite(array).all():
            k = int(np.argwhere(~np.isfinite(array))[0][0])
            row = k if isinstance(rows, slice) else int(rows[k])
            raise ValueError(_not_finite(f"{type(batch).__name__}.compute: {label}", row))
    return residual, jacobians


def _not_finite(what: str, row: int) -> str:
    return (
        f"{what} must be finite; row {row} is not. Look at the start values and at the heights of surfaces "
        "that its contacts name."
    )


def nonlinear_graph(graph: BallGraph) -> "tuple[gtsam.NonlinearFactorGraph, list[Bridge]]":
    """A graph for GTSAM's own optimizers, with the bridges that evaluate it (they count the calls)."""
    import gtsam

    bridges = [Bridge(batch) for batch in graph.batches if len(batch)]
    result = gtsam.NonlinearFactorGraph()
    for bridge in bridges:
        for factor in bridge.factors():
            result.push_back(factor)
    return result, bridges


def linear_graph(linearized: Sequence[Rows]) -> "gtsam.GaussianFactorGraph":
    """The whitened rows that `ballfg.factors.solve` eliminates, for GTSAM's elimination and marginals.

    They include the curvature of robust losses, which GTSAM's own linearisation leaves out.
    """
    import gtsam

    result = gtsam.GaussianFactorGraph()
    for rows in linearized:
        residual, jacobians = weighted(rows)
        unit = gtsam.noiseModel.Unit.Create(residual.shape[1])
        for i, variables in enumerate(rows.variables.tolist()):
            terms = [term for v, block in zip(variables, jacobians, strict=True) for term in (key_of(v), block[i])]
            result.push_back(gtsam.JacobianFactor(*terms, -residual[i], unit))  # type: ignore[call-overload]
    return result


def to_gtsam(values: Values) -> "gtsam.Values":
    """States as vectors x0, x1, ..., biases behind them; coefficients, if any, as the vector c0."""
    import gtsam

    result = gtsam.Values()
    for i, state in enumerate(values.gather(np.arange(len(values.states)), with_biases=True)):
        result.insert(STATE_KEY + i, state)
    if len(values.coefficients):
        result.insert(COEFFICIENT_KEY, values.coefficients)
    return result


def from_gtsam(values: "gtsam.Values") -> Values:
    """The values from GTSAM's, as `to_gtsam` wrote them; other variables than x0, x1, ... and c0 are left out."""
    import gtsam

    states = np.array(gtsam.utilities.extractVectors(values, "x"))
    coefficients = np.array(values.atVector(COEFFICIENT_KEY)) if values.exists(COEFFICIENT_KEY) else np.zeros(0)
    biases = states[:, STATE_DIM:] if states.shape[1] > STATE_DIM else None
    return Values(states[:, :STATE_DIM], coefficients, biases)
