"""Multiplies four neighbouring numbers of a row by one instruction, which numba by itself does one after another.

Such four numbers are a value of machine code alone: they are loaded from a row, computed with, and stored. The results
are those of the single numbers, to the last bit.
"""

from typing import Any, Final

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic, models, register_model

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT

FOUR_AT_ONCE: Final = 4
"""Numbers that one instruction multiplies."""
NUMBERS: Final = ir.VectorType(ir.DoubleType(), FOUR_AT_ONCE)
PLACES: Final = ir.VectorType(ir.IntType(64), FOUR_AT_ONCE)
EIGHT_BYTES: Final = 8  # Numbers begin anywhere in an array, not only where four of them would


class _Four(types.Type):
    """The type of four numbers."""

    def __init__(self) -> None:
        super().__init__(name="four_numbers")


FOUR: Final = _Four()


@register_model(_Four)
class _FourModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: _Four) -> None:
        super().__init__(manager, kind, NUMBERS)


def _repeated(builder: Any, kind: ir.VectorType, value: Any) -> Any:
    """A value four times."""
    nothing, first = ir.Constant(kind, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    places = ir.Constant(ir.VectorType(ir.IntType(32), FOUR_AT_ONCE), [0] * FOUR_AT_ONCE)
    return builder.shuffle_vector(builder.insert_element(nothing, value, first), nothing, places)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, row: Any, column: Any) -> Any:
    if kind.layout != "C" or kind.ndim != 2:
        raise TypingError(f"array must be a matrix whose rows lie one behind another; got {kind}. Copy it first.")
    whole = context.make_array(kind)(context, builder, array)
    at = builder.add(builder.mul(row, builder.extract_value(whole.shape, 1)), column)
    return builder.bitcast(builder.gep(whole.data, [at], inbounds=True), NUMBERS.as_pointer())


def _loaded(_context: Any, array: Any, row: Any, column: Any) -> Any:
    def write(context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.load(_pointer(context, builder, array, *given), align=EIGHT_BYTES)

    return FOUR(array, types.int64, types.int64), write


def _stored(_context: Any, array: Any, row: Any, column: Any, four: Any) -> Any:
    def write(context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        builder.store(given[3], _pointer(context, builder, array, *given[:3]), align=EIGHT_BYTES)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, FOUR), write


def _times(_context: Any, number: Any, four: Any) -> Any:
    def write(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.fmul(_repeated(builder, NUMBERS, given[0]), given[1])

    return FOUR(types.float64, FOUR), write


def _plus(_context: Any, one: Any, other: Any) -> Any:
    return FOUR(FOUR, FOUR), lambda _context, builder, _signature, given: builder.fadd(*given)


def _minus(_context: Any, one: Any, other: Any) -> Any:
    return FOUR(FOUR, FOUR), lambda _context, builder, _signature, given: builder.fsub(*given)


def _behind(_context: Any, column: Any, first: Any, four: Any) -> Any:
    def write(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        columns = builder.add(_repeated(builder, PLACES, given[1]), ir.Constant(PLACES, list(range(FOUR_AT_ONCE))))
        chosen = builder.icmp_signed(">", columns, _repeated(builder, PLACES, given[0]))
        return builder.select(chosen, given[2], ir.Constant(NUMBERS, [0.0] * FOUR_AT_ONCE))

    return FOUR(types.int64, types.int64, FOUR), write


load: Final[Any] = intrinsic(_loaded)
"""load(array, row, column): the numbers of a row of a matrix from a column on."""
store: Final[Any] = intrinsic(_stored)
"""store(array, row, column, four): writes them there."""
times: Final[Any] = intrinsic(_times)
"""times(number, four): each of them times a number."""
plus: Final[Any] = intrinsic(_plus)
"""plus(one, other): their sums."""
minus: Final[Any] = intrinsic(_minus)
"""minus(one, other): their differences."""
behind: Final[Any] = intrinsic(_behind)
"""behind(column, first, four): zeros in place of those up to a column, where they stand in the columns from `first`."""


@machine_code(COUNT(COUNT))
def padded(columns: int) -> int:
    """The next multiple of `FOUR_AT_ONCE`."""
    return -(-columns // FOUR_AT_ONCE) * FOUR_AT_ONCE
